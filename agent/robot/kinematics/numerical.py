"""Inverse kinematics of any serial arm by damped least squares, many poses and seeds at once.

Steps Δq = Jᵀ (J Jᵀ + λ I)⁻¹ e with λ proportional to the squared error (Sugihara, IEEE Trans. Robotics 27 (2011) 984):
robust far from the solution and quadratic near it. Rotations are weighed with the arm's length, so that errors are in
metres. An arm of fewer than six joints must be given poses that it can reach exactly; one of seven takes the solution
nearest to its guess.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.kinematics.base import (
    LARGEST_STEP,
    SINGULAR_DISTANCE,
    InverseSolutions,
    Kinematics,
    KinematicsError,
    pose_error,
    position_text,
    singular,
)
from agent.robot.kinematics.chain import KinematicChain

#: Converged: this part of the arm's length.
ACCURACY = 1e-12
#: Most solutions kept for one pose.
BRANCHES = 8
_SEEDS = 48
_ITERATIONS = 80
_NEARLY = 1e-3  # of the arm's length: an error at which a stalled iteration is near a solution, not out of reach
_SETTLED = 1e-11  # rad or m: steps so small change nothing
_TINY = 1e-13
_LONGEST = 0.2  # rad or m: a step towards the nearest solution
_DISTINCT = 1e-4  # rad or m: solutions nearer than this are one
_POSES_AT_ONCE = 100
_STRETCH = 64
_NEIGHBOURS = 0.3  # rad: joints of neighbouring poses that are nearer than this are on one branch


class NumericalKinematics(Kinematics):
    """Multiple seeds for `inverse` and `solve`, continuation for `follow`."""

    def __init__(self, robot: RobotDescription, chain: KinematicChain):
        super().__init__(robot, chain)
        self.length = float(np.linalg.norm(chain.transforms[:, :3, 3], axis=1).sum()) or 1.0
        low = np.where(np.isfinite(self.lower), self.lower, np.where(self._revolute, -np.pi, -self.length))
        high = np.where(np.isfinite(self.upper), self.upper, np.where(self._revolute, np.pi, self.length))
        spread = np.random.default_rng(0).uniform(low, high, (_SEEDS - 1, self.dof))
        self._seeds = np.vstack([(low + high) / 2, spread])

    def inverse(self, poses: np.ndarray) -> InverseSolutions:
        """As in `Kinematics`, with the branches in the order they were found; other solutions may exist."""
        poses = np.asarray(poses, dtype=float)
        parts = [self._candidates(poses[k : k + _POSES_AT_ONCE]) for k in range(0, len(poses) or 1, _POSES_AT_ONCE)]
        fields = ("q", "valid", "within_limits", "singular", "unreachable")
        return InverseSolutions(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))

    def follow(self, poses: np.ndarray, start: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """As in `Kinematics`. A redundant arm is followed pose by pose, so that its path is as smooth as the poses."""
        poses = np.asarray(poses, dtype=float)
        if near is not None and self.dof > 6:
            return self._follow_near(poses, np.asarray(near, dtype=float))
        q = np.empty((len(poses), self.dof))
        if len(poses) == 0:
            return q
        first, error = self._converge(poses[:1], np.asarray(start, dtype=float)[None])
        if not error[0] < ACCURACY * self.length:
            self._raise(0, poses[0], first, error)
        q[0] = first[0]
        longest = 1 if self.dof > 6 else _STRETCH
        done, stretch = 0, longest
        while done < len(poses) - 1:
            stretch = min(stretch, len(poses) - 1 - done)
            if self._follow_stretch(poses, q, done, stretch):
                done, stretch = done + stretch, min(2 * stretch, longest)
            else:
                stretch //= 2
        self._check_singularity(poses, q)
        return q

    def nearest(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, n) joints of a redundant arm at poses (S, 4, 4) nearest to `seeds` (S, n), and where there are some (S,).

        Where the pose is reached, ½|q - seed|² has a minimum: J⁺J (q - seed) = q - seed. From the seed on, Newton's
        steps towards the pose and the full step towards the seed within the null space; full turns are not taken off.
        What is found is a function of pose and seed alone, as smooth as they are.
        """
        q, error = self._converge(poses, seeds)
        solved = error < ACCURACY * self.length
        weights = np.repeat([1.0, self.length], 3)
        active = np.flatnonzero(solved)
        for _ in range(_ITERATIONS):
            if len(active) == 0:
                break
            reached, jacobian = self.chain.forward_and_jacobian(q[active])
            jacobian = jacobian * weights[:, None]
            transposed = jacobian.transpose(0, 2, 1)
            residual = pose_error(poses[active], reached) * weights
            difference = seeds[active] - q[active]
            # J⁺ e + (1 - J⁺ J) difference, J⁺ = Jᵀ (J Jᵀ)⁻¹; what is added keeps a singular pose finite until refused
            asked = residual[:, :, None] - jacobian @ difference[:, :, None]
            square = jacobian @ transposed + _TINY * self.length**2 * np.eye(6)
            step = np.clip(difference + (transposed @ np.linalg.solve(square, asked))[:, :, 0], -_LONGEST, _LONGEST)
            q[active] += step
            active = active[np.abs(step).max(axis=1) > _SETTLED]
        solved[active] = False
        return q, solved

    def roomiest(self, poses: np.ndarray) -> np.ndarray | None:
        """Joints (n,) of a redundant arm at the first of poses (S, 4, 4), with the largest margin to the limits at all.

        Room is the distance to the nearest limit of any joint over all poses, each reached by the joints nearest to
        those at the first; poses that are not reached within the limits count most. None where the first is not.
        """
        options, solved = self.nearest(np.repeat(poses[:1], len(self._seeds), axis=0), self._seeds)
        options = options[solved & self.within_limits(options)]
        if len(options) == 0:
            return None
        q, reached = self.nearest(np.tile(poses, (len(options), 1, 1)), np.repeat(options, len(poses), axis=0))
        inside = np.minimum(np.minimum(q - self.lower, self.upper - q).min(axis=1), np.pi)  # no limit: half a turn
        inside = np.where(reached, inside, -np.inf).reshape(len(options), len(poses))
        joints_inside = (inside >= 0).sum(axis=1)
        return options[np.lexsort((-np.where(inside >= 0, inside, np.inf).min(axis=1), -joints_inside))[0]]

    def _follow_near(self, poses: np.ndarray, references: np.ndarray) -> np.ndarray:
        """(S, n) as `nearest`, on one branch.

        Raises:
            KinematicsError: as in `follow`.
        """
        q, solved = self.nearest(poses, references)
        if not solved.all():
            index = int(np.flatnonzero(~solved)[0])
            closest, error = self._converge(poses[index : index + 1], references[index : index + 1])
            if error[0] < ACCURACY * self.length:
                self._raise_branch(index, poses[index], float(np.abs(closest - references[index]).max()))
            self._raise(index, poses[index], closest, error)
        turned = np.abs(np.diff(q, axis=0))[:, self._revolute].max(axis=1)
        if turned.max(initial=0.0) > LARGEST_STEP:
            index = int(turned.argmax()) + 1
            self._raise_branch(index, poses[index], float(turned.max()))
        self._check_singularity(poses, q)
        return q

    def _check_singularity(self, poses: np.ndarray, q: np.ndarray) -> None:
        suspects = self._suspects(q)
        distances = np.full(len(q), np.inf)
        distances[suspects] = self.singularity(q[suspects])[:, 0]
        if distances.min(initial=np.inf) < SINGULAR_DISTANCE:
            index = int(np.flatnonzero(distances < SINGULAR_DISTANCE)[0])
            raise singular(index, poses[index], float(distances.min()), f" for {self.robot.name}")

    def _suspects(self, q: np.ndarray) -> np.ndarray:
        """(S,) bool: configurations that a bound on the singular values does not clear, which costs a tenth of them.

        Of m singular values with squares that sum to F², the smallest over the largest is at least the product of all,
        √det J Jᵀ, over the largest product that the others can have, (F² / (m - 1))^((m - 1) / 2), and over F.
        """
        jacobian = self.jacobian(q)
        jacobian[:, 3:] *= self.length
        transposed = jacobian.transpose(0, 2, 1)
        square = jacobian @ transposed if self.dof >= 6 else transposed @ jacobian
        others = square.shape[1] - 1
        whole = np.einsum("sii->s", square)
        product = np.sqrt(np.maximum(np.linalg.det(square), 0.0))
        return ~(product * max(others, 1) ** (0.5 * others) > 2.0 * SINGULAR_DISTANCE * whole ** (0.5 * others + 0.5))

    def find(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.dof > 6:
            q, solved = self.nearest(poses, seeds)
        else:
            # Most are next to where they are looked for: no other solution is nearer than one that is on this branch.
            q, error = self._converge(poses, seeds)
            solved = (error < ACCURACY * self.length) & (np.abs(q - seeds)[:, self._revolute] <= _NEIGHBOURS).all(
                axis=1
            )
        solved &= self.within_limits(q)
        solved[solved] = self.singularity(q[solved])[:, 0] >= SINGULAR_DISTANCE
        unsolved = np.flatnonzero(~solved)
        for k in range(0, len(unsolved), _POSES_AT_ONCE):
            part = unsolved[k : k + _POSES_AT_ONCE]
            q[part], solved[part] = super().find(poses[part], seeds[part])
        return q, solved

    def singularity(self, q: np.ndarray) -> np.ndarray:
        """One kind, "arm": smallest over largest singular value of the Jacobian (rotations weighed by the length)."""
        jacobian = self.jacobian(q)
        jacobian[:, 3:] *= self.length
        values = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray(values[:, -1:] / np.maximum(values[:, :1], np.finfo(float).tiny))

    def _refuse(self, pose: np.ndarray) -> NoReturn:
        q, error = self._converge(np.repeat(pose[None], _SEEDS, axis=0), self._seeds)
        best = [int(np.nanargmin(error))] if np.isfinite(error).any() else [0]
        self._raise(0, pose, q[best], error[best])

    def _candidates(self, poses: np.ndarray, seeds: np.ndarray | None = None) -> InverseSolutions:
        samples = len(poses)
        starts = np.broadcast_to(self._seeds, (samples, *self._seeds.shape))
        if seeds is not None:
            starts = np.concatenate([seeds[:, None], starts], axis=1)
        tried = starts.shape[1]
        q, error = self._converge(np.repeat(poses, tried, axis=0), starts.reshape(-1, self.dof))
        distance = self.singularity(q).reshape(samples, tried)
        q = self.nearest_turn(q, self.middle).reshape(samples, tried, self.dof)
        error = error.reshape(samples, tried)
        reached = error < ACCURACY * self.length
        # An iteration slows down on its way into a singular solution, so there "nearly" counts.
        stalled = (error < _NEARLY * self.length) & (distance < np.sqrt(SINGULAR_DISTANCE)) & ~reached
        singular = (reached & (distance < SINGULAR_DISTANCE)) | stalled
        candidates = np.full((samples, BRANCHES, self.dof), np.nan)
        for k in range(samples):
            count = 0
            for candidate in q[k, reached[k] & ~singular[k]]:
                if count < BRANCHES and not self._known(candidates[k, :count], candidate):
                    candidates[k, count] = candidate
                    count += 1
        valid = np.isfinite(candidates).all(axis=2)
        flag = np.zeros((samples, BRANCHES), dtype=bool)
        flag[:, -1] = singular.any(axis=1) & ~valid[:, -1]
        return InverseSolutions(
            q=candidates,
            valid=valid,
            within_limits=valid & self.within_limits(candidates),
            singular=flag,
            unreachable=~valid.any(axis=1) & ~flag.any(axis=1),
        )

    def _known(self, known: np.ndarray, candidate: np.ndarray) -> bool:
        apart = np.abs(self.nearest_turn(known, candidate) - candidate)
        return bool((apart < _DISTINCT).all(axis=1).any())

    def _converge(self, poses: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (S, n) from guesses (S, n), and the error (S,) [m] that is left."""
        q = np.array(guess, dtype=float)
        error = np.full(len(q), np.inf)
        active = np.arange(len(q))
        weights = np.repeat([1.0, self.length], 3)
        longest = np.where(self._revolute, 0.5, 0.5 * self.length)
        for _ in range(_ITERATIONS):
            reached, jacobian = self.chain.forward_and_jacobian(q[active])
            residual = pose_error(poses[active], reached) * weights
            error[active] = np.linalg.norm(residual, axis=1)
            going = ~(error[active] < ACCURACY * self.length)
            active, residual, jacobian = active[going], residual[going], jacobian[going]
            if len(active) == 0:
                break
            step = self._damped_step(jacobian * weights[:, None], residual)
            q[active] += step / np.maximum(np.abs(step / longest).max(axis=1, keepdims=True), 1.0)
        return q, error

    def _damped_step(self, jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
        damping = 0.5 * (residual**2).sum(axis=1) + 1e-12 * self.length**2
        transposed = jacobian.transpose(0, 2, 1)
        eye = damping[:, None, None] * np.eye(min(self.dof, 6))
        if self.dof < 6:
            right = transposed @ residual[:, :, None]
            return np.linalg.solve(transposed @ jacobian + eye, right)[:, :, 0]
        return (transposed @ np.linalg.solve(jacobian @ transposed + eye, residual[:, :, None]))[:, :, 0]

    def _follow_stretch(self, poses: np.ndarray, q: np.ndarray, done: int, stretch: int) -> bool:
        """Fill q after `done` for `stretch` poses; False if the stretch is too long to be sure of the branch.

        Raises:
            KinematicsError: not even a single step succeeds.
        """
        target = done + stretch
        end, error = self._converge(poses[target : target + 1], q[done : done + 1])
        reached = error[0] < ACCURACY * self.length
        turned = np.abs(end[0] - q[done])[self._revolute].max(initial=0.0)
        if stretch == 1:
            if not reached:
                self._raise(target, poses[target], end, error)
            if turned > LARGEST_STEP:
                self._raise_branch(target, poses[target], float(turned))
            q[target] = end[0]
            return True
        if not reached or turned > _NEIGHBOURS:
            return False
        between = poses[done + 1 : target]
        part = np.linspace(0.0, 1.0, stretch + 1)[1:-1, None]
        inside, error = self._converge(between, q[done] + part * (end[0] - q[done]))
        path = np.vstack([q[done], inside, end])
        steps = np.abs(np.diff(path, axis=0))[:, self._revolute]
        if not (error < ACCURACY * self.length).all() or steps.max(initial=0.0) > _NEIGHBOURS:
            return False
        q[done + 1 : target + 1] = path[1:]
        return True

    def _raise(self, index: int, pose: np.ndarray, q: np.ndarray, error: np.ndarray) -> NoReturn:
        distance = float(self.singularity(q)[0, 0])
        if error[0] < _NEARLY * self.length and distance < np.sqrt(SINGULAR_DISTANCE):
            raise singular(index, pose, distance, f" for {self.robot.name}")
        raise KinematicsError(
            index,
            "unreachable",
            f"pose {index} at {position_text(pose)} cannot be reached by the {self.dof} joints of {self.robot.name}: "
            f"the nearest pose found is off by {error[0]:.3g} m (a radian counts as {self.length:.3f} m)",
            float(error[0] / self.length) if np.isfinite(error[0]) else np.inf,
        )

    def _raise_branch(self, index: int, pose: np.ndarray, turned: float) -> NoReturn:
        raise KinematicsError(
            index,
            "branch",
            f"at pose {index}, {position_text(pose)}, a joint would have to turn by {turned:.2f} rad at once: the path "
            "crosses a singularity there",
            turned / LARGEST_STEP - 1.0,
        )
