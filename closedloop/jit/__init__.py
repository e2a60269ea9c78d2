"""Everything that depends on the compiler; nothing here depends on mechanics."""
