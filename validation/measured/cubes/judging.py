"""The table of `python -m validation.measured cubes`: engines side by side, and the published figures beside."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from closedloop.base.errors import ModelError
from validation.measured.cubes.comparing import (
    Tried,
    against,
    engines,
    fits,
    held_out,
    numbers_of,
    over_impacts,
    over_time,
    source_of,
    training,
    tried,
)
from validation.measured.cubes.tosses import Toss, read
from validation.measured.judged import Judged

# Mean position error, % of the side, and mean rotation error, degrees, of engines that others fitted to these tosses:
# B. Acosta, W. Yang, M. Posa, Validating robotics simulators on real-world impacts, IEEE Robotics and Automation
# Letters 7(3), 2022.
PUBLISHED = {"Drake": (13.5, 16.5), "Bullet": (14.9, 16.5), "MuJoCo": (25.1, 21.7)}
OURS = "closedloop"
Growth = Callable[[Sequence[Toss], Tried], Sequence[tuple[float, float, float]]]


def judge(given: Path | None = None) -> Judged:
    """Simulate the tosses with every engine that is installed, and compare.

    A fault is a toss that this package does not complete, or an engine that is closer to the tosses on average.

    Raises `ModelError` if the file cannot be read, or has no toss that the engines were not fitted to.
    """
    shipped = read()
    tosses = held_out(read(given) if given else shipped, shipped)
    if not tosses:
        raise ModelError(f"{given}: every toss is one that the engines were fitted to: give others")
    judged = Judged("A cube tossed onto a board", source_of(given))
    known = fits()
    results = {engine.name: tried(engine, tosses) for engine in engines() if engine.name in known}
    trained = len(training(shipped))
    judged.lines += [
        f"{len(tosses)} tosses, simulated from the first row; engines are fitted to {trained} others by one search",
        "",
        f"  {'':12}{'position':>10}{'95 %':>16}{'rotation':>11}{'95 %':>16}"
        f"{'completed':>11}{'start fitted':>18}{'a toss':>10}",
    ]
    for name, one in results.items():
        told = judged.numbers[name] = numbers_of(one) | {"simulations": known[name]["simulations"]}
        judged.lines.append(_line(name, told))
        if told["completed"] < told["tosses"] and name == OURS:
            judged.faults.append(f"{told['tosses'] - told['completed']} of {told['tosses']} tosses were not completed")
    for name, (position, rotation) in PUBLISHED.items():
        judged.lines.append(f"  {name:12}{position:>8.1f} %{'published':>16}{rotation:>10.1f}°")
    judged.numbers["published"] = {
        name: {"position_percent": p, "rotation_degrees": r} for name, (p, r) in PUBLISHED.items()
    }
    judged.lines += ["", "fitted"]
    for name, one in results.items():
        values = judged.numbers[name]["parameters"]
        listed = (
            f"{p.name} {values[p.name]:.4g}{'' if p.unit == '1' else ' ' + p.unit}" for p in one.engine.parameters
        )
        judged.lines.append(f"  {name:12}{', '.join(listed)}")
    _compare(judged, results)
    _growth(judged, results, tosses)
    return judged


def _line(name: str, told: dict[str, Any]) -> str:
    done = f"{told['completed']}/{told['tosses']}"
    if told["position_percent"] is None:
        return f"  {name:12}{done:>64}"
    low, high = told["position_percent_interval"]
    turned_low, turned_high = told["rotation_degrees_interval"]
    started = f"{told['position_percent_start_fitted']:.1f} %, {told['rotation_degrees_start_fitted']:.1f}°"
    return (
        f"  {name:12}{told['position_percent']:>8.1f} %{f'{low:.1f} to {high:.1f}':>16}"
        f"{told['rotation_degrees']:>10.1f}°{f'{turned_low:.1f} to {turned_high:.1f}':>16}"
        f"{done:>11}{started:>18}{1e3 * told['seconds_per_toss']:>7.0f} ms"
    )


def _compare(judged: Judged, results: dict[str, Tried]) -> None:
    """Add by how much this package's errors are below those of each other engine."""
    others = [name for name in results if name != OURS]
    if others:
        judged.lines += ["", "mean errors of closedloop below those of"]
    for name in others:
        below = judged.numbers[OURS].setdefault("below", {})[name] = against(results[OURS], results[name])
        texts = []
        for kind, each in below.items():
            low, high = (100 * end for end in each["interval"])
            texts.append(f"{kind} {100 * each['below']:+.1f} % ({low:+.1f} to {high:+.1f})")
            if each["below"] < 0.0:
                judged.faults.append(f"{kind} error: {-100 * each['below']:.1f} % above that of {name}")
        judged.lines.append(f"  {name:12}{', '.join(texts)}")


def _growth(judged: Judged, results: dict[str, Tried], tosses: list[Toss]) -> None:
    """Add the errors over time and over the number of impacts: small differences grow with each."""
    growths: tuple[tuple[str, str, Growth], ...] = (
        ("errors at an instant, s", "over_time", over_time),
        ("errors after a number of impacts", "over_impacts", over_impacts),
    )
    for title, key, rows_of in growths:
        judged.lines += ["", title]
        for name, one in results.items():
            rows = rows_of(tosses, one)
            judged.numbers[name][key] = [list(row) for row in rows]
            told = (f"{at:>4g}: {position:>4.1f} %, {rotation:>4.1f}°" for at, position, rotation in rows)
            judged.lines.append(f"  {name:12}{'  '.join(told)}")
