"""A simulation behind an interface: the controller is another program, and drives it as it would drive an arm.

`serve` opens it; `session` is the simulation and its record, real time, ports with one client at a time, and what every
interface is. `messages` are our own messages, as JSON or binary, `franka` is the interface of Franka's arms, `ur` that
of Universal Robots' arms for data.
"""

from closedloop.base.upwards import make_callable

make_callable(__name__, "closedloop.serve.serve:serve")
