"""What the tip can touch."""
