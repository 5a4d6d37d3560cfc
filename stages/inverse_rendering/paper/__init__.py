"""The paper's own trainer and renderer, for comparison. Only stages.inverse_rendering.systems imports it."""
