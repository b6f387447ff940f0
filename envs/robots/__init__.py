"""Robot models, one module each, built from figures with primitives only."""
