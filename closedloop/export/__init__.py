"""Runs in formats of other programs: CSV for spreadsheets, MCAP for Foxglove and ROS 2 (``closedloop export``)."""
