"""What every package may use: errors, files, Ctrl-C, progress, second processes, sections, families of plug-ins."""
