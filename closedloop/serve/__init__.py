"""A simulation behind an interface: the controller is another program, and drives it as it would drive an arm.

`serve` opens it; `interface` is what every interface is; `session` the simulation and its record; `sockets` the ports,
with one client at a time; `clock` real time. `plain` and `messages` are our own messages, as JSON or binary, and
`franka` is the interface of Franka's arms.
"""

from collections.abc import Callable
from typing import Any

from closedloop.base.callable_package import make_callable


def _function() -> Callable[..., Any]:
    from closedloop.serve.serve import serve

    return serve


make_callable(__name__, _function)
