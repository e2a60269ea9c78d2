"""Who provides the terms and who drives the loop."""
