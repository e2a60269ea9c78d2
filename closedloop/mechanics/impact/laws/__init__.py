"""The laws of restitution that ship, a file each; what they share is told in `closedloop.mechanics.impact`."""
