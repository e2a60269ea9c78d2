"""The mechanics: robot, surface, closure, loops of joints, friction, impact, contacts of links, and integrators."""
