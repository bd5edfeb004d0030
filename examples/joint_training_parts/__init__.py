"""What the joint training example is made of: the scenes it sees and the detector it trains."""
