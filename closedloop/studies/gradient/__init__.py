"""Derivatives of whole runs with respect to numbers of their scenario."""
