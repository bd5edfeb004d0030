"""The estimation problem: what was measured, what is unknown, and the objective between them."""
