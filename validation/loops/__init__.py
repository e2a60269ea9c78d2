"""Mechanisms with loops: the motion and the reactions of the loop against the paper's R by hand (Eqs. 1–10).

mechanisms  the mechanisms, as text
cases       a state of one of them, closed, and what acts on it
answers     what the oracle and both engines of the loop say of a case
peers       what other engines say of it that can hold such loops
compare     the table of the harness
faults      faults planted in each new term, and what catches them
"""
