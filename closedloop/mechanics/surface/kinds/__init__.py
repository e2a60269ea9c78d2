"""The surfaces that ship, one file each: the file's name is the `kind` of [surface]."""
