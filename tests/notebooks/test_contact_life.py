"""What contact_life prints is true: numbers of the closed form, computed here again, and counts of runs made here.

The quick tests read the committed notebook; that it is what its script gives today is held by `test_notebooks`.
"""

import numpy as np
import pytest
from notebook_output import number, printed, saved

import closedloop as cl

GRAVITY, HEIGHT, RESTITUTION, MASS = 9.81, 1.0, 0.9, 2.0
FIRST = np.sqrt(2 * HEIGHT / GRAVITY)


@pytest.fixture(scope="module")
def lines():
    """Return the lines that the notebook prints."""
    return printed(saved("contact_life"))


def numbers(lines, label):
    """Return the numbers after the label in the one line that begins with it."""
    (line,) = [line for line in lines if line.startswith(label)]
    return [x for x in map(number, line.removeprefix(label).split()) if x is not None]


def below(lines, header):
    """Return the lines below that header that begin with a number, as words."""
    first = next(k for k, line in enumerate(lines) if line.startswith(header)) + 1
    rows = []
    for line in lines[first:]:
        if number(line.split()[0]) is None:
            break
        rows.append(line.split())
    assert rows
    return rows


def test_transitions_are_counted(lines):
    """The table has, for each scenario, the events of its kind and the rows that stay in contact."""
    for name in ("wam_touchdown", "wam_bounce", "wam_edge", "wam_liftoff"):
        run = cl.simulate(cl.load_scenario(name))
        kinds = [event.kind for event in run.events]
        kept = sum(a == b == 1 for a, b in zip(run.mode[:-1], run.mode[1:], strict=True))
        assert numbers(lines, name + " ") == [
            kinds.count("impact"),
            kinds.count("touchdown"),
            kept,
            kinds.count("liftoff"),
        ]


def test_ball_meets_the_ground_when_the_closed_form_says(lines):
    """Each printed impact is at t1 + 2 t1 Σ εᵏ, and the closed form beside it is that as well."""
    rows = [[float(word) for word in row] for row in below(lines, "impact   simulated")]
    assert len(rows) == 6
    for n, simulated, exact, difference in rows:
        flights = sum(RESTITUTION**k for k in range(1, int(n)))
        assert exact == pytest.approx(FIRST * (1 + 2 * flights), abs=1e-10)
        assert simulated == pytest.approx(exact, abs=2e-10)
        assert abs(difference) < 1e-10


def test_zeno_time_is_reached_with_what_was_cut(lines):
    """The last event and the bounces that were cut away make the Zeno time, t1 (1 + ε)/(1 − ε)."""
    zeno = FIRST * (1 + RESTITUTION) / (1 - RESTITUTION)
    (closed,) = numbers(lines, "Zeno time, closed form")
    last, *_ = numbers(lines, "the last event")
    (cut,) = numbers(lines, "bounces that were cut away")
    (together,) = numbers(lines, "together")
    assert closed == pytest.approx(zeno, abs=1e-12)
    assert together == pytest.approx(zeno, abs=1e-10)
    assert last + cut == pytest.approx(together, abs=2e-12)
    assert 0.0 < cut < 1e-3


def test_ball_loses_what_the_formula_says(lines):
    """The first impact costs (1 − ε²)/2 m u² with u² = 2 g h, and all together cost m g h."""
    simulated, formula = numbers(lines, "energy lost in the first impact")
    assert formula == pytest.approx((1 - RESTITUTION**2) * MASS * GRAVITY * HEIGHT, abs=1e-9)
    assert simulated == pytest.approx(formula, abs=1e-8)
    total, height = numbers(lines, "in all impacts")
    assert total == pytest.approx(MASS * GRAVITY * HEIGHT, abs=1e-8)
    assert height == pytest.approx(total, abs=0.005)
    count, worst = numbers(lines, "impacts   ")
    assert count == 101  # 4.43 · 0.9ⁿ m/s is below 1e-4 m/s from n = 102 on
    assert worst < 1e-10


def test_arm_loses_what_the_formula_says(lines):
    """Every meeting costs (1 − ε²)/2 m u² with the arm's effective mass; impacts keep ε, the touchdown nothing."""
    rows = below(lines, "time [s]   event")
    assert [row[1] for row in rows][-1] == "touchdown"
    assert len(rows) > 2
    for _, kind, rate, share, lost, formula in rows:
        assert float(rate) < 0.0
        assert float(share) == (0.3 if kind == "impact" else 0.0)
        assert float(lost) == pytest.approx(float(formula), rel=0.01)


def test_force_rises_to_what_is_commanded(lines):
    """At the touchdown the force is below 10 N, and 10 N when the path arrives and at the end."""
    assert 2.0 < numbers(lines, "f in the first row of contact")[0] < 9.0
    arrival, force = numbers(lines, "f when the path arrives,")
    assert arrival == 2.0
    assert force == pytest.approx(10.0, abs=0.05)
    assert numbers(lines, "f at the end") == pytest.approx([10.0], abs=1e-3)


def test_arm_bounces_as_a_ball_of_its_effective_mass(lines):
    """The fall takes √(2 h m/f) but for damping; every bounce keeps 0.7; at last the force is 10 N."""
    (mass,) = numbers(lines, "effective mass of the tip")
    arm, _, ball = numbers(lines, "first impact")  # between them the 10 N
    assert ball == pytest.approx(np.sqrt(2 * 0.05 * mass / 10.0), abs=1e-3)
    assert arm == pytest.approx(ball, rel=0.1)
    assert numbers(lines, "after/before, least and greatest") == [0.7, 0.7]
    assert numbers(lines, "f after that") == pytest.approx([10.0], abs=1e-3)


def test_surface_lets_go_where_the_force_is_zero(lines):
    """The liftoff is where the force, drawn on, is zero, with no impulse and no force after it."""
    assert 0.0 < numbers(lines, "f in the last row of contact")[0] < 0.05
    assert numbers(lines, "liftoff   ") == pytest.approx(numbers(lines, "f drawn on to zero"), abs=2e-5)
    assert numbers(lines, "f in the first free row") == [0.0]
    impulse, lost = numbers(lines, "impulse and energy lost")
    assert impulse == 0.0
    assert abs(lost) < 1e-12


def test_tip_leaves_with_the_sign_of_the_command(lines):
    """The command is negative from 1 + 10/7 s to 4 + 4/7 s; the tip leaves with it and is back after it."""
    below_zero = numbers(lines, "commanded force below zero")
    assert below_zero == pytest.approx([1 + 10 / 7, 4 + 4 / 7], abs=1e-4)
    leaves, returns = numbers(lines, "tip off the surface")
    assert leaves == pytest.approx(below_zero[0], abs=0.005)
    assert below_zero[1] < returns < below_zero[1] + 0.2


def test_unbroken_contact_is_the_same_run(lines):
    """A unilateral surface changes nothing of a run that never leaves it."""
    assert numbers(lines, "number of events") == [0]
    assert numbers(lines, "largest difference of f") == [0.0]
    assert numbers(lines, "largest difference of q") == [0.0]
