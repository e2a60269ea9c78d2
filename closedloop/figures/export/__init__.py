"""Runs in formats of other programs: CSV for spreadsheets, MCAP for ROS 2, MJCF for MuJoCo (``closedloop export``)."""
