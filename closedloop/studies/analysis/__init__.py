"""The force loop, linear about the motion at an instant: poles, margins, the port, and where it is stable."""
