"""The parts of the joint training example: the scenes and the detector."""
