"""The paths that ship, one file each: the name of a file is the `kind` of [reference] that picks its path."""
