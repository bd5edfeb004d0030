"""Whether a calibration can be trusted: findings, a verdict, an acceptance test, and a check of old calibrations."""
