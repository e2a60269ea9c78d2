"""The motions of a surface that ship, one file each: the file's name is the `kind` of [surface_motion]."""
