"""The lab: the whole experiment answers while a gain is dragged (`closedloop lab`, or ``cl.lab("wam_slide")``).

What is drawn is data (`curves`, `drawn`, `strip`), what can be moved follows from the scenario's schema (`controls`,
`groups`). The page is in `web`: with a server it is the lab (`app`), with data inside it is what `Run.show` opens and
`share` writes.

The package can be called, since ``closedloop.lab`` is its name as a module and as a function.
"""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any


class _Lab(ModuleType):
    """This package, as a function: see `closedloop.lab.start.lab`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        from closedloop.lab.start import lab

        return lab(*arguments, **options)

    @property
    def __signature__(self) -> inspect.Signature:
        from closedloop.lab.start import lab

        return inspect.signature(lab)


sys.modules[__name__].__class__ = _Lab
