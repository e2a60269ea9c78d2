"""What happens in a step: one evaluation of the equation of motion (`step`), and what happens within it (`events`)."""
