"""A planar arm of two links: data, and its dynamics in closed form."""
