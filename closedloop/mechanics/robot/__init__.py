"""The arm: H, C, r, Jᵣ and J̇ᵣq̇, from Pinocchio or from terms of our own."""
