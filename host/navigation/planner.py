"""A collision-free way through joint space: two trees that grow towards one another (RRT-Connect), then short cuts."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Free = Callable[[Array], bool]
# Greatest motion of the tip, about, along one branch and between two checks (m).
BRANCH_M, CHECK_M = 0.006, 0.0012


class _Tree:
    """Joints (n, 3) scaled to metres, each with its parent."""

    def __init__(self, roots: list[Array]) -> None:
        self.points = [np.array(root) for root in roots]
        self.parents = [-1] * len(roots)

    def nearest(self, point: Array) -> int:
        return int(np.argmin(np.sum((np.array(self.points) - point) ** 2, axis=1)))

    def add(self, point: Array, parent: int) -> int:
        self.points.append(point)
        self.parents.append(parent)
        return len(self.points) - 1

    def path(self, index: int) -> list[Array]:
        """Return the joints from `index` to the root of the tree."""
        out = []
        while index >= 0:
            out.append(self.points[index])
            index = self.parents[index]
        return out


def free_between(start: Array, end: Array, free: Free, check_m: float = CHECK_M) -> bool:
    """Return whether the straight line between two scaled joints is free of collision; both ends are assumed free."""
    count = int(np.ceil(np.linalg.norm(end - start) / check_m))
    order = sorted(range(1, count), key=lambda k: k & -k, reverse=True)
    return all(free(start + (end - start) * k / count) for k in order)


def connect(
    starts: list[Array], goals: list[Array], low: Array, high: Array, free: Free, seed: int, most: int
) -> list[Array] | None:
    """Scaled joints from one of `starts` to one of `goals`, straight ways between them free; None after `most` samples."""
    random = np.random.default_rng(seed)
    trees, swapped = (_Tree(starts), _Tree(goals)), False
    for number in range(most):
        here, there = (trees[1], trees[0]) if swapped else trees
        sample = there.points[int(random.integers(len(there.points)))] if number % 5 == 0 else random.uniform(low, high)
        new = _extend(here, sample, free)
        if new is not None:
            target, met = here.points[new], _grow_to(there, here.points[new], free)
            if np.allclose(there.points[met], target, atol=1e-12):
                first, second = here.path(new)[::-1], there.path(met)
                return (second[::-1] + first[::-1][1:]) if swapped else first + second[1:]
        swapped = not swapped
    return None


def _extend(tree: _Tree, sample: Array, free: Free) -> int | None:
    near = tree.nearest(sample)
    way = sample - tree.points[near]
    length = float(np.linalg.norm(way))
    if length < 1e-9:
        return near
    point = sample if length <= BRANCH_M else tree.points[near] + way * BRANCH_M / length
    if not free(point) or not free_between(tree.points[near], point, free):
        return None
    return tree.add(point, near)


def _grow_to(tree: _Tree, target: Array, free: Free) -> int:
    """Extend the tree towards `target` until it is reached or blocked; return the index of the last point."""
    last = tree.nearest(target)
    while not np.allclose(tree.points[last], target, atol=1e-12):
        way = target - tree.points[last]
        length = float(np.linalg.norm(way))
        point = target if length <= BRANCH_M else tree.points[last] + way * BRANCH_M / length
        if not free(point) or not free_between(tree.points[last], point, free):
            break
        last = tree.add(point, last)
    return last


def shorten(path: list[Array], free: Free, seed: int, tries: int = 150) -> list[Array]:
    """Shorten the path by direct connections between random points of it."""
    random = np.random.default_rng(seed)
    path = list(path)
    for _ in range(tries):
        if len(path) < 3:
            break
        i, j = sorted(random.choice(len(path), 2, replace=False))
        if j - i > 1 and free_between(path[i], path[j], free):
            path = path[: i + 1] + path[j:]
        else:
            path = _halfway(path, random)
    return path


def _halfway(path: list[Array], random: np.random.Generator) -> list[Array]:
    """Add a point on the longest segment, so that later direct connections can begin there; at most 60 points."""
    if len(path) >= 60:
        return path
    legs = [float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(path)]
    k = int(np.argmax(legs))
    share = float(random.uniform(0.3, 0.7))
    return path[: k + 1] + [path[k] + share * (path[k + 1] - path[k])] + path[k + 1 :]
