"""Several scenarios under the same variations: one table, one figure."""
