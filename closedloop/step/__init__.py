"""One evaluation of the equation of motion, the integrators, and the row that a step leaves."""
