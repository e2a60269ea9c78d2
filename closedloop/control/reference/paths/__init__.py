"""The paths that ship, one file each: the name of a file is the `kind` of its path in [reference]."""
