"""The columns that a run has: those recorded, its events, and what follows from them."""
