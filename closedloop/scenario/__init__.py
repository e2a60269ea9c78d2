"""Scenarios: reading, validation, overrides, units."""
