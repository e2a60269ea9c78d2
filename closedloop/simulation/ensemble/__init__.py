"""Many simulations that are stepped side by side, driven from outside."""
