"""Friction of a tip that slides on a plane: Coulomb's and a viscous part.

    −F_t·u = μ f + b |ṙ_t|,   u = ṙ_t/|ṙ_t|

Both forces are read by one sensor with noise, so that least squares would make μ too small by the share of the
noise in f²; f of the windows before and behind, whose noise is another, is the instrument. Windows in which the tip may
stick, or turns round, do not count. F_t across u has to vanish: it does not if the normal is another, or friction is
not the same in all directions.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from closedloop.base.arrays import Array
from closedloop.studies.identify.contact.found import FEWEST, SURE, Part, known, missed, one, spread, unknown
from closedloop.studies.identify.contact.sensor import Sensor
from closedloop.studies.identify.contact.touch import Windows
from closedloop.studies.identify.regressor import NOISY

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
