"""The mind of a robot: mapping, features, merging, fleet (all pure), and the process that runs them."""

__version__ = "0.1.0"
