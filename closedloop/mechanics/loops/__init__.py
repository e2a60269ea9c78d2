"""Loop joints: their rows at a state, and what they leave free of the motion of the tree."""
