"""Six-dimensional spatial vectors: one point, one set of axes, angular part first.

Convention of the whole oracle (Featherstone's, written in base coordinates). Every spatial vector that
leaves a function of `kinematics` or `dynamics` is expressed along the axes of the base frame and taken *at
the base origin O*, whatever body it belongs to:

- a motion vector is (ω, v_O): angular velocity, and the velocity of the body-fixed point that passes through
O;
- a force vector is (n_O, f): the couple about O, and the force;
- their product n_O·ω + f·v_O is a power.

Spatial vectors of different bodies can then be added without any transform, which is why the recursions
of the oracle are so short, and the velocity of a point r is simply v_O + ω × r (Eqs. 13 and 16 of the paper).

The functions take arrays with leading batch axes and any numeric dtype: float, complex (for complex-step
differentiation) and object holding mpmath numbers (for a reference in as many digits as one likes).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def skew(a: Array) -> Array:
    """Return a× (..., 3, 3), which multiplies like the cross product with a (..., 3): (a×) b = a × b."""
    a = np.asarray(a)
    out = np.zeros((*a.shape, 3), dtype=a.dtype)
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def cross_motion(v: Array) -> Array:
    """Return v× (..., 6, 6), the rate of a motion vector m carried along at spatial velocity v (..., 6): ṁ = v × m.

    v× = [ ω×    0  ]
         [ v_O×  ω× ]
    """
    v = np.asarray(v)
    out = np.zeros((*v.shape, 6), dtype=v.dtype)
    out[..., :3, :3] = out[..., 3:, 3:] = skew(v[..., :3])
    out[..., 3:, :3] = skew(v[..., 3:])
    return out


def cross_force(v: Array) -> Array:
    """Return v×* (..., 6, 6), the rate of a force vector f carried along at spatial velocity v (..., 6): ḟ = v ×* f.

    v×* = −(v×)ᵀ, because the power f·m of two vectors carried along together stays the same.
    """
    return -np.swapaxes(cross_motion(v), -1, -2)


def cross_swapped(f: Array) -> Array:
    """Return f×̄* (..., 6, 6), skew-symmetric: v×*f as a matrix acting on v, of f (..., 6): (f×̄*) v = v ×* f.

    f×̄* = −[ n_O×  f× ]
           [ f×    0  ]
    """
    f = np.asarray(f)
    out = np.zeros((*f.shape, 6), dtype=f.dtype)
    out[..., :3, :3] = -skew(f[..., :3])
    out[..., :3, 3:] = out[..., 3:, :3] = -skew(f[..., 3:])
    return out


def motion_to_base(rotation: Array, position: Array) -> Array:
    """Return the Plücker transform X (..., 6, 6) that takes a motion vector from a frame's coordinates to base ones.

        X = [ R     0 ]
            [ p×R   R ]

    rotation, position: (..., 3, 3), (..., 3), axes and origin of the frame, base coordinates, m
    """
    out = np.zeros((*rotation.shape[:-2], 6, 6), dtype=np.result_type(rotation, position))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(position) @ rotation
    return out


def motion_from_base(rotation: Array, position: Array) -> Array:
    """Return X⁻¹ (..., 6, 6), which takes a motion vector from base coordinates to a frame's; see `motion_to_base`.

        X⁻¹ = [  Rᵀ      0  ]
              [ −Rᵀp×    Rᵀ ]

    Its transpose takes a *force* vector from the frame's coordinates to base ones.
    """
    transposed = np.swapaxes(rotation, -1, -2)
    out = np.zeros((*rotation.shape[:-2], 6, 6), dtype=np.result_type(rotation, position))
    out[..., :3, :3] = out[..., 3:, 3:] = transposed
    out[..., 3:, :3] = -(transposed @ skew(position))
    return out


def spatial_inertia(mass: float, centre: Array, about_centre: Array) -> Array:
    """Return the spatial inertia of a rigid body about the origin of the frame its data are given in.

        I = [ I_c − m c×c×   m c× ]
            [ −m c×          m 1  ]

    mass: [kg]
    centre: (3,) centre of mass c, in the frame [m]
    about_centre: (3, 3) rotational inertia tensor about the centre of mass, along the frame's axes [kg m²]
    Returns (6, 6) symmetric; maps a motion vector to a momentum.
    """
    c = skew(np.asarray(centre, dtype=float))
    out = np.zeros((6, 6))
    out[:3, :3] = about_centre - mass * c @ c
    out[:3, 3:] = mass * c
    out[3:, :3] = -mass * c
    out[3:, 3:] = mass * np.eye(3)
    return out


def about_centre(inertia: Array) -> tuple[float, Array, Array]:
    """Return mass, kg, centre (3,), m, and the tensor (3, 3) about it, kg m², of a spatial inertia."""
    mass = float(inertia[5, 5])
    if mass == 0.0:
        return 0.0, np.zeros(3), np.array(inertia[:3, :3])
    block = inertia[:3, 3:] / mass  # c×
    return mass, np.array([block[2, 1], block[0, 2], block[1, 0]]), inertia[:3, :3] + mass * block @ block


def inertia_to_base(rotation: Array, position: Array, inertia: Array) -> Array:
    """Return X⁻ᵀ I X⁻¹ (..., 6, 6): a spatial inertia in a frame, taken to base coordinates; see `motion_to_base`."""
    inverse = motion_from_base(rotation, position)
    return np.asarray(np.swapaxes(inverse, -1, -2) @ inertia @ inverse)


def axes_about(direction: Array) -> Array:
    """Return a rotation (3, 3) whose third column is the unit vector `direction` (3,)."""
    across = np.cross(np.eye(3)[np.argmin(np.abs(direction))], direction)
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across), direction], axis=1)


def rotation_from_rpy(rpy: Array) -> Array:
    """Return the rotation (3, 3) of a URDF ``rpy`` (3,), rad: about the fixed axes x, y, z in turn, R = R_z R_y R_x."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)


def cos_sin(angle: Array) -> tuple[Array, Array]:
    """Return the cosines and sines of an array of angles; mpmath numbers (dtype object) keep their digits."""
    angle = np.asarray(angle)
    if angle.dtype != object:
        return np.cos(angle), np.sin(angle)
    import mpmath

    out_cos, out_sin = np.empty_like(angle), np.empty_like(angle)
    for index, value in np.ndenumerate(angle):
        out_cos[index], out_sin[index] = mpmath.cos(value), mpmath.sin(value)
    return out_cos, out_sin
