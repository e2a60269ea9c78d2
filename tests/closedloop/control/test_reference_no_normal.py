"""Paths over places at which a formula's gradient vanishes or jumps: found wherever they are, and nowhere else."""

import re

import numpy as np
import pytest

import closedloop as cl
from closedloop.control.reference import tip_path
from closedloop.control.reference.tip_path import Segment, TipPath, refuse_without_normal
from closedloop.mechanics.surface.motion import MOTIONS
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import SURFACES

AT = (-0.2, 0.0, 0.0)
SPEED, DURATION = np.array([0.05, 0.02, 0.0]), 4.0


def implicit(expression):
    """The surface of a formula whose normal at AT is z, in base axes."""
    section, frame = SURFACES["implicit"](expression=expression, at=AT), np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    return PlacedSurface(section, MOTIONS["none"](), frame, np.array(AT), False)


def edge(a, b=0.0, high=1.0):
    """A formula that is z as far as x = a, and leads down beyond, wherever y is."""
    return f"z + {high}*(sqrt((x - {float(a)!r})**2) + (x - {float(a)!r}))"


def point(a, b, left=0.0):
    """A formula that is z times a factor, of which so much is left at x = a, y = b."""
    return f"z*((x - {float(a)!r})**2 + (y - {float(b)!r})**2 + {left!r})"


def path(begins=1.0, count=1, start=(0.0, 0.0, 0.0)):
    """A path along a line at a constant speed, in so many segments."""

    def curve(s):
        return s[:, None] * SPEED * DURATION / count, np.tile(SPEED * DURATION / count, (s.size, 1)), 0.0 * s[:, None]

    def timing(t, whole):
        return t / whole, np.full(t.size, 1.0 / whole), np.zeros(t.size)

    each = DURATION / count
    ends = begins + each * np.arange(count + 1)
    segments = tuple(
        Segment(ends[k], ends[k + 1], np.array(start) + SPEED * each * k, curve, timing, 1.0) for k in range(count)
    )
    return TipPath(np.array(start), segments)


def told(surface, tip, does):
    """The instant and the place of the refusal."""
    with pytest.raises(cl.ScenarioError, match=f"the gradient of its φ {does} there") as refusal:
        refuse_without_normal(surface, tip)
    found = re.match(r"reference: at t = (\S+) s the path comes to \[(.*)\] m", str(refusal.value))
    return float(found[1]), np.array([float(x) for x in found[2].split(",")])


@pytest.fixture(autouse=True)
def few_instants(monkeypatch):
    """Look at few instants first: each costs."""
    monkeypatch.setattr(tip_path, "NORMAL_CHECKS", 20)


@pytest.mark.parametrize(
    ("does", "instant"),
    [*(("vanishes", t) for t in (1.0, 1.05, 2.71828, 5.0 - 1e-6, 5.0)), *(("jumps", t) for t in (1.001, 4.999))],
)
def test_a_place_without_normal_is_found_wherever_it_is(does, instant):
    """A single point where the factor of a formula is zero, and an edge: between instants, near the ends, at them."""
    a, b, _ = SPEED * (instant - 1.0) + [0.0, -1e-9, 0.0]
    when, where = told(implicit(edge(a) if does == "jumps" else point(a, b)), path(start=(0.0, -1e-9, 0.0)), does)
    assert when == pytest.approx(instant, abs=1e-3)
    assert not np.any(np.signbit(where))
    np.testing.assert_allclose(where[:2], [a, b], atol=1e-4)


def test_places_in_a_path_of_several_segments():
    """Near the end of the first, at it, and in the second of three; a path of another start and beginning."""
    tip = path(begins=0.0, count=3, start=(0.01, 0.0, 0.0))

    def steeper(a, b):
        return f"({edge(a)})*(1 + 1e4*(x + 0.2)**4)"

    for instant, form, does in ((1.3334, edge, "jumps"), (4.0 / 3.0, point, "vanishes"), (2.2, steeper, "jumps")):
        a, b, _ = SPEED * instant + [0.01, 0, 0]
        assert told(implicit(form(a, b)), tip, does)[0] == pytest.approx(instant, abs=1e-3)


@pytest.mark.parametrize(
    "form",
    [
        point(0.1, 0.04, 1e-6),  # small, and nowhere zero
        f"1e-6*{point(0.1, 0.04, 1e-6)}",  # whatever the formula is multiplied by
        point(0.1, 0.041),  # passed at a millimetre
        "z + sqrt((x - 0.1)**2 + 1e-8) + (x - 0.1)",  # an edge rounded by a tenth of a millimetre
        edge(0.3),  # beyond the end
        edge(0.1, high=0.05),  # an edge that is none to speak of
    ],
)
def test_what_has_a_normal_all_along_is_not_refused(form):
    """However much, and however quickly, it turns."""
    refuse_without_normal(implicit(form), path())


def test_a_tip_that_stays_is_not_refused():
    """Wherever it is: the start is another's business."""
    refuse_without_normal(implicit(point(0, 0)), TipPath(np.zeros(3)))
