"""Rigid and similarity transforms, and angles.

A transform is a (4, 4) float64 matrix `T_target_source`: p_target = T_target_source @ p_source. Roll, pitch and yaw turn about the
fixed x, y and z axes in this order (R = Rz(yaw) Ry(pitch) Rx(roll)); quaternions are in the order x, y, z, w.
"""

import functools

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from streetscan.errors import BadInput


def transform(xyz_m: np.ndarray = (0, 0, 0), rpy_rad: np.ndarray = (0, 0, 0)) -> np.ndarray:
    """The transform (..., 4, 4) with a translation (..., 3) in metres and roll, pitch, yaw (..., 3) in radians."""
    xyz_m, rpy_rad = np.broadcast_arrays(np.asarray(xyz_m, np.float64), np.asarray(rpy_rad, np.float64))
    rotations = Rotation.from_euler("xyz", rpy_rad.reshape(-1, 3)).as_matrix()
    return _assemble(rotations.reshape(*rpy_rad.shape[:-1], 3, 3), xyz_m)


def transform_of_quaternion(xyz_m: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """The transform (..., 4, 4) with a translation (..., 3) in metres and a quaternion (..., 4), x y z w, of any length but zero."""
    xyz_m, xyzw = np.asarray(xyz_m, np.float64), np.asarray(xyzw, np.float64)
    rotations = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix()
    return _assemble(rotations.reshape(*xyzw.shape[:-1], 3, 3), xyz_m)


def transform_of_rotation(rotation: np.ndarray, xyz_m: np.ndarray = (0, 0, 0)) -> np.ndarray:
    """The transform (..., 4, 4) with a rotation matrix (..., 3, 3) and a translation (..., 3) in metres."""
    return _assemble(np.asarray(rotation, np.float64), np.asarray(xyz_m, np.float64))


def rpy_of_transform(T: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (..., 3) in radians of transforms (..., 4, 4); at a pitch of 90 degrees yaw and roll share one turn."""
    T = np.asarray(T, np.float64)
    return Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_euler("xyz", suppress_warnings=True).reshape(*T.shape[:-2], 3)


def quaternion_of_transform(T: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), x y z w with w >= 0, of transforms (..., 4, 4)."""
    T = np.asarray(T, np.float64)
    return Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True).reshape(*T.shape[:-2], 4)


def compose(*transforms: np.ndarray) -> np.ndarray:
    """The product T_a_b @ T_b_c @ ... of transforms (..., 4, 4)."""
    return functools.reduce(np.matmul, transforms)


def invert(T: np.ndarray) -> np.ndarray:
    """The inverse (..., 4, 4) of rigid or similarity transforms (..., 4, 4): T_source_target of T_target_source."""
    T = np.asarray(T, np.float64)
    A = T[..., :3, :3]
    scale = np.cbrt(np.linalg.det(A))[..., None, None]
    A_inverse = np.swapaxes(A, -1, -2) / scale**2
    return _assemble(A_inverse, -(A_inverse @ T[..., :3, 3:])[..., 0])


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the source frame in the target frame of T (4, 4), or of one T (N, 4, 4) each; float64."""
    T, points = np.asarray(T, np.float64), np.asarray(points, np.float64)
    if T.ndim == 2:
        return points @ T[:3, :3].T + T[:3, 3]
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def moved_by(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """T (4, 4) after a turn (rotation vector, rad) and a shift (m), (6,), in the axes of the frame it leads to."""
    return transform_of_rotation(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]) @ T


def steps_between(T: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(K, 6) what `moved_by` takes to make T (4, 4) each of the poses (K, 4, 4)."""
    turns = Rotation.from_matrix(poses[:, :3, :3] @ T[:3, :3].T)
    return np.concatenate([turns.as_rotvec(), poses[:, :3, 3] - turns.apply(T[:3, 3])], axis=1)


def interpolate_poses(times_s: np.ndarray, pose_times_s: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses at given times: positions linearly, rotations along the shortest turn.

    Args:
        times_s: (N,) times wanted.
        pose_times_s: (K,) times of the poses, strictly increasing.
        poses: (K, 4, 4) transforms.
    Returns:
        (N, 4, 4); NaN where a time lies before the first or after the last pose, for nothing is known there.
    Raises:
        ValueError: no pose, or times that do not increase.
    """
    times_s = np.atleast_1d(np.asarray(times_s, np.float64))
    pose_times_s, poses = np.asarray(pose_times_s, np.float64), np.asarray(poses, np.float64)
    if len(poses) == 0 or len(poses) != len(pose_times_s):
        raise ValueError(f"{len(poses)} poses with {len(pose_times_s)} times")
    if (np.diff(pose_times_s) <= 0).any():
        raise ValueError("times of the poses do not increase")
    interpolated = np.full((len(times_s), 4, 4), np.nan)
    inside = (times_s >= pose_times_s[0]) & (times_s <= pose_times_s[-1])
    if not inside.any():
        return interpolated
    if len(poses) == 1:
        interpolated[inside] = poses[0]
        return interpolated
    positions = np.stack([np.interp(times_s[inside], pose_times_s, poses[:, i, 3]) for i in range(3)], axis=-1)
    rotations = Slerp(pose_times_s, Rotation.from_matrix(poses[:, :3, :3]))(times_s[inside]).as_matrix()
    interpolated[inside] = _assemble(rotations, positions)
    return interpolated


def fit_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> np.ndarray:
    """The similarity that brings corresponding points closest together in the least-squares sense.

    Args:
        source, target: (N, 3) corresponding points, N >= 3, not on one line.
        with_scale: False keeps the scale at 1, which makes the result rigid.
    Returns:
        T_target_source (4, 4): scale times rotation, and translation; the scale is the cube root of its determinant.
    Raises:
        ValueError: fewer than three points, or points on one line.
    Source: Umeyama (1991), Eqs. 40-43.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if len(source) < 3 or source.shape != target.shape:
        raise ValueError(f"{len(source)} and {len(target)} points; three or more pairs are needed")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    for name, spread in (("source", a), ("target", b)):
        singular = np.linalg.svd(spread, compute_uv=False)
        if singular[1] <= 1e-9 * max(singular[0], 1e-300):
            raise ValueError(f"the {name} points lie on one line")
    U, D, Vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ np.diag(signs) @ Vt
    scale = (D * signs).sum() / (a**2).sum(axis=1).mean() if with_scale else 1.0
    return _assemble(scale * R, mean_target - scale * R @ mean_source)


def angle_difference(a_rad: np.ndarray, b_rad: np.ndarray) -> np.ndarray:
    """a - b the short way round, radians in [-pi, pi)."""
    return (np.asarray(a_rad) - np.asarray(b_rad) + np.pi) % (2 * np.pi) - np.pi


def rotation_angle(T: np.ndarray) -> np.ndarray:
    """The angle (...,) in radians, 0 to pi, by which transforms (..., 4, 4) or rotations (..., 3, 3) turn."""
    T = np.asarray(T, np.float64)
    return Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).magnitude().reshape(T.shape[:-2])


def check_rotation(matrix: np.ndarray, where: object, tolerance: float = 1e-3) -> np.ndarray:
    """The rotation nearest to a matrix that a file calls a rotation and stored with a few digits.

    Args:
        matrix: (3, 3).
        where: the file or key it came from, named in the error.
        tolerance: largest deviation of `matrix @ matrix.T` from the identity.
    Returns:
        (3, 3) float64, orthonormal with determinant 1.
    Raises:
        BadInput: not finite, not orthonormal within the tolerance, or a reflection.
    """
    matrix = np.asarray(matrix, np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all():
        raise BadInput(where, "the rotation has NaN or infinite entries", "write nine finite numbers, row by row")
    deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    determinant = float(np.linalg.det(matrix))
    if deviation > tolerance or determinant < 0:
        raise BadInput(
            where,
            f"is no rotation (R R^T deviates from the identity by {deviation:.3g}, determinant {determinant:.3g})",
            "write an orthonormal matrix with determinant 1, row by row",
        )
    U, _, Vt = np.linalg.svd(matrix)
    return U @ Vt


def _assemble(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T
