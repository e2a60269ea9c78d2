"""Many runs with one question: sweeps, and the studies of the paper's kind."""
