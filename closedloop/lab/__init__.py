"""The lab: the whole experiment answers while a gain is dragged (`closedloop lab`, or ``cl.lab("wam_slide")``).

What is drawn is data (`curves`, `drawn`), what can be moved follows from the scenario's schema (`controls`). The page
is in `web`: with a server it is the lab (`app`), with data inside it is what `Run.show` opens and `share` writes.

The package can be called, since ``closedloop.lab`` is its name as a module and as a function.
"""

from closedloop.base.upwards import make_callable

make_callable(__name__, "closedloop.lab.start:lab")
