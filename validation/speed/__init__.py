"""How fast a step is, beside peers that do the same work: ``python -m validation.speed``; the method is docs/speed.md.

contestants   slides of arms with two to thirty joints, and who steps them: our engines, Pinocchio, MuJoCo, Drake
scenes        bodies and robots in contact, beside MuJoCo
loops         mechanisms with loops
repeated      many runs, episodes and derivatives, and a fresh interpreter, to its first result
measure       laps, interleaved; wall time and processor time; medians, spread, ratios of neighbours; what is printed
served        steps for another program, ``python -m validation.speed.served``
lab           the lab: from a slider to the new curves, also in its page, ``python -m validation.speed.lab``
"""
