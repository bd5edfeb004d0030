"""Cameras, rigid transforms and small symmetric matrices: geometry that knows nothing of calibration."""
