"""How good a trajectory is: metrics against a reference, and tables of them."""
