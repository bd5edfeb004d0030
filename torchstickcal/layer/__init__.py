"""The calibration as a differentiable layer."""
