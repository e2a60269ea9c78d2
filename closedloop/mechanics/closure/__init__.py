"""Rows that bind the arm, Eq. 24 and its conditioning, the stabilisers, the contact force."""
