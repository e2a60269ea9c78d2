"""What a log says of a contact: friction, a surface that gives, restitution, the force sensor."""
