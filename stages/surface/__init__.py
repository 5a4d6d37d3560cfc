"""Surface stage: the zero set of the fitted SDF as one closed triangle mesh."""
