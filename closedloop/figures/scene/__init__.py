"""A robot and its surface as shapes in space, for the laboratory and the pages that are drawn from it."""
