"""Contact with surfaces that are curved, move, rub or give way: the loop's rows against the paper's Eqs. 2–3 by hand.

cases    random states on random surfaces
answers  what the oracle, the loop's two engines and the peers say of a case
compare  the tables of the harness
faults   faults planted in each new term, and what catches them
mujoco   MuJoCo's own soft contact with a ball beside Kelvin and Voigt's
"""
