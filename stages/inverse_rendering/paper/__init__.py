"""The paper's own trainer and renderer, to compare with. stages.inverse_rendering.systems is the one door."""
