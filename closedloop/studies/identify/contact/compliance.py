"""A surface that gives, and friction on it, from a log. Of the surface stiffness, damping, where it is without a force,
and how late the force is read.

    f(t + τ) = k (d − n·r(t)) − c n·ṙ(t)

Small delays enter as τ k n·ṙ + τ c n·r̈: beside damping a delay is told by the acceleration alone. It is found by
steps of Gauss and Newton, each a linear fit with the positions of every other row as instruments for those between.
Positions that encoders count are those between their counts (`closedloop.studies.identify.motion.between_counts`);
what these leave is no noise, and is in the intervals by `closedloop.studies.identify.contact.identify_contact`.

Friction of a tip that slides on a plane: Coulomb's and a viscous part.

    −F_t·u = μ f + b |ṙ_t|,   u = ṙ_t/|ṙ_t|

Both forces are read by one sensor with noise, so that least squares would make μ too small by the share of the
noise in f²; f of the windows before and behind, whose noise is another, is the instrument. Windows in which the tip may
stick, or turns round, do not count. F_t across u has to vanish: it does not if the normal is another, or friction is
not the same in all directions.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from closedloop.base.arrays import Array
from closedloop.studies.identify.contact.found import (
    FEWEST,
    SURE,
    Part,
    Sensor,
    Windows,
    known,
    missed,
    one,
    spread,
    unknown,
)
from closedloop.studies.identify.fit import Fit
from closedloop.studies.identify.identify import Estimate
from closedloop.studies.identify.motion import Motion, white_noise
from closedloop.studies.identify.regressor import NOISY

# The tip has to sink in by so many times the noise of its filtered height, and by this, m.
NOISES, LEAST = 3.0, 1e-8
# Steps of the search for the delay, and the longest that is looked for, in periods of the filter.
STEPS, LONGEST = 12, 2.0
NAMES = (("stiffness", "N/m"), ("damping", "N s/m"), ("delay", "s"), ("surface_offset", "m"))


def compliance_of(windows: Windows, sensor: Sensor, z: float) -> Part:
    """Return stiffness, damping, offset of the surface, and the delay of the force if the sensor's is not known."""
    part = Part("normal force, N")
    touch, n = windows.touch, windows.touch.normal
    used = windows.within(touch.closed)
    height = windows.mean(windows.x.q @ n)
    if used.sum() < FEWEST:
        why = "the tip never touches for long: press it on the surface"
        part.estimates = [unknown(name, unit, why) for name, unit in NAMES]
        return part
    noise = float(white_noise(touch.height[:, None])[0]) * np.sqrt(2.0 * touch.step * windows.cutoff)
    sinks = float(height[used].std())
    if sinks < max(NOISES * noise, LEAST):
        why = (
            f"the tip moves by {sinks:.2g} m along the normal while it touches, which is no more than noise: the "
            "surface is too stiff for this log; press harder, or measure closer to the tip"
        )
        part.estimates = [unknown(name, unit, why) for name, unit in NAMES]
        return part
    middle = float(height[used].mean())

    def rows(x: Motion) -> Array:
        return np.stack([windows.mean(row @ n) for row in (x.q, x.v, x.a)], axis=1) - [middle, 0.0, 0.0]

    even, odd = rows(windows.even), rows(windows.odd)

    def force(value: Array) -> Array:
        wrench = sensor.contact_force(windows, value)
        return wrench @ n if wrench.shape[1] == 3 else wrench[:, 0]

    def read(late: float) -> Array:
        return np.append(sensor.value[:-1], late)

    def columns(s: Array, k: float, c: float) -> Array:
        """Return those of k, k (d − middle), c and, of a delay that is looked for, its change."""
        return np.column_stack(
            [-s[:, 0], np.ones(len(s)), -s[:, 1]] + ([] if sensor.delay_known else [k * s[:, 1] + c * s[:, 2]])
        )

    late, k, c = float(sensor.value[-1]), 1.0, 1.0
    if not sensor.delay_known:
        late, k, c = _begin(even, odd, force(read(0.0)), used)
    longest = LONGEST / windows.cutoff
    for _ in range(STEPS):
        y = force(read(late))
        W, Z = columns(even, k, c), columns(odd, k, c)
        found = one(W, y, used, Z)
        k, c = float(found.value[0]), float(found.value[2])
        if sensor.delay_known or not found.told.all():
            break
        step = float(np.clip(found.value[3], -0.5 * longest, 0.5 * longest))
        late = float(np.clip(late + step, -longest, longest))
        if abs(step) < 1e-3 * float(found.deviation[3]):
            break

    def solved(value: Array) -> Array:
        return one(W, force(value), used, Z).value

    covariance = found.covariance + spread(solved, read(late), sensor.covariance)
    part.estimates = _estimates(found, covariance, late, middle, sensor, z)
    deep = odd[:, 0].max() - odd[:, 0]  # from the highest point of the contact
    extra = {
        "a stiffness that grows or falls with depth": deep**2,
        "damping that grows with depth (Hunt and Crossley)": deep * odd[:, 1],
    }
    rate_noise = 2.0 * np.pi * windows.cutoff / np.sqrt(3.0) * noise
    of_log = float(np.sqrt(np.sum(windows.x.torque_noise**2) + 2.0 * ((k * noise) ** 2 + (c * rate_noise) ** 2)))
    part.misses = [f"surface: {what}" for what in missed(W, y, used, Z, extra, found, of_log)]
    part.time, part.measured, part.predicted = windows.x.time[used], y[used], (y - found.residual[:, 0])[used]
    return part


def _begin(even: Array, odd: Array, y: Array, used: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Return delay, stiffness and damping to begin with: from f = −k s − (c − k τ) ṡ − (k τ²/2 − c τ) s̈ + constant."""
    found = one(*(np.column_stack([-even, np.ones(len(even))]), y, used), np.column_stack([-odd, np.ones(len(odd))]))
    k, a, b = (float(x) for x in found.value[:3])
    if k <= 0.0:
        return 0.0, max(k, 1.0), 1.0
    c = float(np.sqrt(max(a * a - 2.0 * k * b, 0.0)))
    return (c - a) / k, k, c


def _estimates(found: Fit, covariance: Array, late: float, middle: float, sensor: Sensor, z: float) -> list[Estimate]:
    """Return stiffness, damping, delay and offset of the surface."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    k = float(found.value[0])
    told = [known("stiffness", k, float(deviation[0]), "N/m", z)]
    apart = sensor.delay_known or bool(found.told[2:].all())
    if apart:
        told.append(known("damping", float(found.value[2]), float(deviation[2]), "N s/m", z))
    else:
        why = "damping cannot be distinguished from a delay here: press faster and slower, or give the delay"
        told.append(unknown("damping", "N s/m", why))
    if apart and not sensor.delay_known:
        told.append(known("delay", late, float(deviation[3]), "s", z))
    elif not apart:
        told.append(unknown("delay", "s", "a delay cannot be distinguished from damping here: press faster and slower"))
    if sensor.part.estimates[0].why:
        why = "it looks like a bias of the sensor, which is known if the tip is free for a while"
        told.append(unknown("surface_offset", "m", why))
        return told
    # d = middle + (k (d − middle))/k
    slope = np.array([-found.value[1] / k**2, 1.0 / k])
    variance = float(slope @ covariance[:2, :2] @ slope)
    return [*told, known("surface_offset", middle + float(found.value[1]) / k, np.sqrt(variance), "m", z)]


# Below this share of its largest speed a tip may stick.
SLOW = 0.05
# The speed has to vary by this share beside the normal force, or both parts of the friction are one.
VARIES = 0.05
# Windows on either side that the instrument is averaged over.
NEAR = 4
# A tip that slides less than this, m/s, rests.
REST = 1e-5
# A force across the slip above this share of the one along it is none of friction.
ACROSS = 0.05


def friction_of(windows: Windows, sensor: Sensor, z: float) -> Part:
    """Return μ and the viscous coefficient, N s/m."""
    part = Part("friction, N")
    touch, x, n = windows.touch, windows.x, windows.touch.normal
    if x.torque.shape[1] != 3:
        why = "the log has the normal force only: give three components of the force"
        part.estimates = [unknown("friction", "1", why), unknown("viscous_friction", "N s/m", why)]
        return part
    slip = x.v - np.outer(x.v @ n, n)
    speed = np.linalg.norm(slip, axis=1)
    noise = float(np.linalg.norm(x.noise - (x.noise @ np.abs(n)) * np.abs(n)))
    least = max(SLOW * float(speed.max()), NOISY * noise, REST)
    one_way = windows.mean((speed > least).astype(np.float64)) == 1.0
    along = windows.mean(slip / np.maximum(speed, 1e-300)[:, None])
    used = windows.within(touch.closed) & one_way & (np.linalg.norm(along, axis=1) > 0.99)
    used[1:-1] &= one_way[2:] & one_way[:-2]
    mean_speed = windows.mean(speed)

    def forces(value: Array) -> tuple[Array, Array]:
        force = sensor.contact_force(windows, value)
        f = force @ n
        return f, force - np.outer(f, n)

    f, tangential = forces(sensor.value)
    if used.sum() < FEWEST:
        closed = windows.within(touch.closed)
        ratio = np.linalg.norm(tangential[closed], axis=1) / np.maximum(f[closed], 1e-300)
        low = float(np.percentile(ratio, 99.0)) if len(ratio) else 0.0
        why = "the tip never touches for long: press it on the surface, and slide it"
        if len(ratio):
            why = f"the tip hardly slides while it touches (μ is at least {low:.3g}): slide it, both ways"
        part.estimates = [unknown("friction", "1", why, low), unknown("viscous_friction", "N s/m", why)]
        return part
    ratio = (mean_speed / np.maximum(f, 1e-300))[used]
    varies = float(ratio.std() / ratio.mean()) > VARIES

    def columns(f: Array) -> tuple[Array, Array]:
        near = (uniform_filter1d(f, 2 * NEAR + 1) * (2 * NEAR + 1) - f) / (2 * NEAR)
        W, Z = np.column_stack([f, mean_speed]), np.column_stack([near, mean_speed])
        return (W, Z) if varies else (W[:, :1], Z[:, :1])

    def solved(value: Array) -> Array:
        f, tangential = forces(value)
        W, Z = columns(f)
        return one(W, -np.einsum("ij,ij->i", tangential, along), used, Z).value

    W, Z = columns(f)
    y = -np.einsum("ij,ij->i", tangential, along)
    found = one(W, y, used, Z)
    covariance = found.covariance + spread(solved, sensor.value, sensor.covariance)
    deviation = np.sqrt(np.diag(covariance))
    mean = float(mean_speed[used].mean() / f[used].mean())
    grouping = "" if varies else f"friction + {mean:.4g} viscous_friction"
    part.estimates.append(known("friction", float(found.value[0]), float(deviation[0]), "1", z, grouping))
    if varies:
        part.estimates.append(known("viscous_friction", float(found.value[1]), float(deviation[1]), "N s/m", z))
    else:
        why = "the tip slides at one speed: slide it at several, under one force"
        part.estimates.append(unknown("viscous_friction", "N s/m", why))
    top = float(mean_speed[used].max())
    smooth = Z[:, 0]
    extra = {
        "more friction at low speed (Stribeck)": smooth * np.exp(-((mean_speed / (0.25 * top)) ** 2)),
        "friction that grows with the square of the speed": mean_speed**2,
        "friction that is not in proportion to the force": smooth**2,
        "friction even without a force: a bias of the sensor, or another normal": np.ones(len(y)),
    }
    noise_of_force = float(np.linalg.norm(x.torque_noise))
    part.misses = [f"friction: {what}" for what in missed(W, y, used, Z, extra, found, noise_of_force)]
    across = np.cross(np.broadcast_to(n, along.shape), along)
    aside = one(np.ones((len(y), 1)), np.einsum("ij,ij->i", tangential, across), used)
    sideways = abs(float(aside.value[0]))
    if sideways > SURE * aside.deviation[0] and sideways > ACROSS * float(np.abs(y[used]).mean()):
        part.misses.append(
            f"friction: {sideways:.3g} N across the slip: another normal, a bias, or friction that has a direction"
        )
    part.time, part.measured, part.predicted = x.time[used], y[used], (y - found.residual[:, 0])[used]
    return part
