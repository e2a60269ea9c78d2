"""Everything that knows the compiler, and nothing of mechanics."""
