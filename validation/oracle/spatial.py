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
    """Return the matrix a× that multiplies like the cross product: (a×) b = a × b.

    a: (..., 3)
    Returns (..., 3, 3).
    """
    a = np.asarray(a)
    out = np.zeros((*a.shape, 3), dtype=a.dtype)
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def cross_motion(v: Array) -> Array:
    """Return v×, the rate of a motion vector m that is carried along at spatial velocity v: ṁ = v × m.

        v× = [ ω×    0  ]
             [ v_O×  ω× ]

    v: (..., 6) motion vector, base frame at O
    Returns (..., 6, 6).
    """
    v = np.asarray(v)
    out = np.zeros((*v.shape, 6), dtype=v.dtype)
    out[..., :3, :3] = out[..., 3:, 3:] = skew(v[..., :3])
    out[..., 3:, :3] = skew(v[..., 3:])
    return out


def cross_force(v: Array) -> Array:
    """Return v×*, the rate of a force vector f that is carried along at spatial velocity v: ḟ = v ×* f.

    v×* = −(v×)ᵀ, because the power f·m of two vectors carried along together stays the same.

    v: (..., 6) motion vector, base frame at O
    Returns (..., 6, 6).
    """
    return -np.swapaxes(cross_motion(v), -1, -2)


def cross_swapped(f: Array) -> Array:
    """Return f×̄*, which is v×*f seen as a matrix acting on v: (f×̄*) v = v ×* f. It is skew-symmetric.

        f×̄* = −[ n_O×  f× ]
               [ f×    0  ]

    f: (..., 6) force vector, base frame at O
    Returns (..., 6, 6).
    """
    f = np.asarray(f)
    out = np.zeros((*f.shape, 6), dtype=f.dtype)
    out[..., :3, :3] = -skew(f[..., :3])
    out[..., :3, 3:] = out[..., 3:, :3] = -skew(f[..., 3:])
    return out


def motion_to_base(rotation: Array, position: Array) -> Array:
    """Return the Plücker transform X that takes a motion vector from a frame's own coordinates to base ones.

        X = [ R     0 ]
            [ p×R   R ]

    rotation: (..., 3, 3) axes of the frame, base coordinates
    position: (..., 3) origin of the frame, base coordinates [m]
    Returns (..., 6, 6).
    """
    out = np.zeros((*rotation.shape[:-2], 6, 6), dtype=np.result_type(rotation, position))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(position) @ rotation
    return out


def motion_from_base(rotation: Array, position: Array) -> Array:
    """Return X⁻¹, which takes a motion vector from base coordinates to the frame's own.

        X⁻¹ = [  Rᵀ      0  ]
              [ −Rᵀp×    Rᵀ ]

    Its transpose takes a *force* vector from the frame's coordinates to base ones.

    rotation: (..., 3, 3) axes of the frame, base coordinates
    position: (..., 3) origin of the frame, base coordinates [m]
    Returns (..., 6, 6).
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


def inertia_to_base(rotation: Array, position: Array, inertia: Array) -> Array:
    """Return X⁻ᵀ I X⁻¹: a spatial inertia taken from a frame's own coordinates to base ones.

    rotation: (..., 3, 3) axes of the frame, base coordinates
    position: (..., 3) origin of the frame, base coordinates [m]
    inertia: (..., 6, 6) in the frame
    Returns (..., 6, 6).
    """
    inverse = motion_from_base(rotation, position)
    return np.asarray(np.swapaxes(inverse, -1, -2) @ inertia @ inverse)


def rotation_from_rpy(rpy: Array) -> Array:
    """Return the rotation of a URDF ``rpy``: about the fixed axes x, then y, then z, R = R_z R_y R_x.

    rpy: (3,) roll, pitch, yaw [rad]
    Returns (3, 3).
    """
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
