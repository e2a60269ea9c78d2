"""The force loop as a linear system about the motion at an instant: poles, margins, the port, and where it is stable."""
