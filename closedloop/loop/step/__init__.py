"""One evaluation of the equation of motion, one stage of an integrator, and the row recorded at a step."""
