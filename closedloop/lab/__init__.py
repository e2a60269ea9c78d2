"""The lab: the whole experiment answers while a gain is dragged (`closedloop lab`, or ``cl.lab("wam_slide")``).

What is drawn is data (`scene`, `curves`), what can be moved follows from the scenario's schema (`controls`), and the
browser's page is viser's (`app`). The page that `Run.show` opens and `share` writes needs no server (`share`).

The package can be called, since ``closedloop.lab`` is its name as a module and as a function.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Lab(ModuleType):
    """This package, as a function: see `closedloop.lab.start.lab`."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        from closedloop.lab.start import lab

        return lab(*arguments, **options)


sys.modules[__name__].__class__ = _Lab
