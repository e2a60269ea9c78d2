"""The limits of contact: every number by which its methods decide, with its unit and the reason for it.

Shares form one scale, from EXACT to SMALL, by which everything is compared. `LIMITS` has all limits by name.
"""

from typing import NamedTuple, TypeVar

T = TypeVar("T", float, int, tuple[int, ...])


class Limit(NamedTuple):
    """A number by which methods of contact decide."""

    value: float | int | tuple[int, ...]
    unit: str  # "1" of a share or a ratio, "" of a count
    reason: str


LIMITS: dict[str, Limit] = {}


def limit(name: str, value: T, unit: str, reason: str) -> T:
    """Add a limit to `LIMITS`; return its value, which compiled code reads as a constant."""
    LIMITS[name] = Limit(value, unit, reason)
    return value


# Shares of what is compared.
EXACT = limit("EXACT", 1e-13, "1", "equations are solved, energies equal and forces at their limit, but for rounding")
DEPENDENT = limit(
    "DEPENDENT", 1e-10, "1", "a row with less beyond the span of others depends on them; a force that is less is none"
)
FOUND = limit("FOUND", 1e-9, "1", "equations are solved well enough to go on")
SLIGHT = limit(
    "SLIGHT",
    1e-6,
    "1",
    "what is less hardly counts: friction so near to its limit, a tilt, a residual that falls slowly",
)
NEAR = limit("NEAR", 1e-4, "1", "near enough where rows hardly differ, and where the tip's mobility is so small")
SMALL = limit("SMALL", 1e-3, "1", "what is less does not count")

# Speeds.
RESTING = limit(
    "RESTING",
    1e-10,
    "m/s",
    "contacts that come together more slowly do not: impulses leave as much of rows that hardly differ",
)
STILL = limit("STILL", 1e-9, "m/s", "a slip that is slower has no direction of its own")
STICK_SPEED = limit(
    "STICK_SPEED",
    1e-7,
    "m/s",
    "a slip that is slower has only begun, or has ended; what the stabiliser may remove; step of a quotient",
)

# Lengths.
CLOSED = limit("CLOSED", 2e-15, "m", "an error or a negative gap that is less is rounding of n·r − d; or a rate, m/s")
TOUCHING = limit(
    "TOUCHING",
    1e-12,
    "m",
    "within this gap a contact touches, and a joint is at its stop: rounding of a located touch is 1e-14",
)
OFF_SURFACE = limit(
    "OFF_SURFACE",
    1e-10,
    "m",
    "a contact further off its surface is put onto it after an event; one that has not been clear touches again",
)
HOVERING = limit(
    "HOVERING", 1e-9, "m", "a contact whose gap is less may be about to close; more than the stabiliser leaves"
)
BEYOND_EDGE = limit(
    "BEYOND_EDGE", 1e-8, "m", "what is less beyond an edge, or below a surface beside it, may still touch"
)

# Times.
INSTANT = limit(
    "INSTANT",
    1e-14,
    "s",
    "an event is located to this; nearer to a row it happens at the row, nearer to another at the same instant",
)
BREAKING_AWAY = limit(
    "BREAKING_AWAY", 1e-9, "s", "in which a slip that begins takes its direction where the integrator chooses its steps"
)
TIME_STEP_SPAN = limit("TIME_STEP_SPAN", 2e-5, "s", "length of a step of impulses among modes")

# Steps that are divided.
FAST = limit("FAST", 12.5, "rad/s", "a joint that turns faster turns by no more than LARGEST_TURN in a part of a step")
LARGEST_TURN = limit(
    "LARGEST_TURN",
    0.0125,
    "rad",
    "so rk4 leaves the energy of what tumbles to 1e-9; a disc is resolved by the time that FAST takes for it",
)
QUARTER = limit("QUARTER", 0.25, "1", "of both while contacts are closed; of a step, the last of a slip")
MOST_GROWTH = limit("MOST_GROWTH", 2.0, "1", "forces that multiply by more, and are HIGH, have a time step begin")
HIGH = limit("HIGH", 30.0, "1", "as a multiple of the load: near Painlevé's paradox forces have no bound")
MOST_OF = limit(
    "MOST_OF",
    0.9,
    "1",
    "what is more is nearly all: of what is left until slips end, of a residual, a tilt, an angle, a cosine",
)
TENTH = limit(
    "TENTH",
    0.1,
    "1",
    "what a step of impulses puts back of a depth, a part of a step changes of a tilt, a round leaves",
)

# The solver in joint space.
FIRST_RHO = limit("FIRST_RHO", 10.0, "1", "ρ of the first round, as a multiple of the inverse of a contact's mobility")
WIDENING = limit("WIDENING", 4.0, "1", "by which ρ grows from round to round, and the bracket of a search")
STIFF = limit("STIFF", 1e3, "1", "ρ of the last rounds; impulses so many times those that are asked for are none")
STIFFEST_RHO = limit("STIFFEST_RHO", 1e4, "1", "ρ along the homotopy, and where rounds lessen the residual slowly")
WEDGED = limit("WEDGED", 1e6, "1", "forces so many times those that are asked for are none: contacts are wedged")

# Shapes.
PARALLEL = limit(
    "PARALLEL",
    0.02,
    "1",
    "edges whose directions differ by less, a sine, do not cross; their normal may lean so far out",
)
AGAIN = limit("AGAIN", 2.0, "1", "a disc that stands rolls again from so many times the tilt that a step resolves")
SURELY = limit("SURELY", 8.0, "1", "the same, wherever its lowest point is")
SHARE_DEEPER = limit(
    "SHARE_DEEPER",
    0.005,
    "1",
    "how deep another point of a disc's edge may be, of radius and tilt: a polygon of 31 corners",
)

# Counts.
ITERATIONS = limit(
    "ITERATIONS",
    40,
    "",
    "of any iteration, of events at an instant, of instants in a step, and of steps in which modes stay: what has not "
    "converged by then does not",
)
REFINEMENTS = limit(
    "REFINEMENTS", 5, "", "of solutions and their derivatives, and moves of a projection: all converge quickly"
)
HALVINGS = limit("HALVINGS", 12, "", "of a step of Newton's method, and of restitution that no impulses give")
SWEEPS = limit("SWEEPS", 500, "", "of Gauss and Seidel's method over joints with dry friction")
MAX_IN_STEP = limit(
    "MAX_IN_STEP", 2000, "", "events in a step after which modes are not sought any more: a bounce at e = 0.99 has 900"
)
OUTPACED = limit("OUTPACED", 100, "", "events that each row takes off that count")
