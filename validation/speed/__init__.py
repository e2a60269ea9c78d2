"""How fast a step is, beside peers that do the same work: ``python -m validation.speed``; the method is docs/speed.md.

arms          the slides: two, four, seven, twelve and thirty joints
contestants   who steps them: our engines, and Pinocchio in other ways
mujoco        MuJoCo: driven from Python with the same law, bare, and in many threads
batch         many runs at once
measure       laps, interleaved; wall time and processor time; medians, spread, ratios of neighbours
cold          a fresh interpreter, to its first result
lab           the lab: from a slider to the new curves, ``python -m validation.speed.lab``
in_browser    the same in its page, in Chromium without a screen
table         what is printed, and which targets are met
"""
