"""Sub-regions: linear maps from genes to poses, all of them inside."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.motion import ViaRegions, pose_of
from agent.motion.regions import BoxRegion, PointRegion

PATH = [
    pose_of([1.0, -0.2, 0.8, 0.0, np.pi, 0.0]),
    pose_of([1.0, 0.2, 0.8, 0.0, 2.9, 0.0]),
    pose_of([1.2, 0.3, 0.9, 0.3, 2.9, 0.1]),
]
TASK = np.array(
    [pose_of([1.0 + 0.1 * np.cos(t), 0.2 * np.sin(t), 0.8, 0.1 * t, 3.0, 0.0]) for t in np.linspace(0, 6, 300)]
)
REGIONS = {
    "points": ViaRegions.from_points(
        [[1.0, 0.0, 0.8, 0.3, 2.6, 0.1], [1.1, 0.2, 0.9, -0.4, 2.9, 0.0], [1.0, 0.1, 0.7, 3.0, 1.2, -3.0]],
        [[0.1, 0.05, 0.1, 0.3, 0.2, 0.3], [0.1, 0.1, 0.1, 0.2, 0.4, 0.1], [0.0, 0.0, 0.2, 0.5, 0.3, 0.4]],
    ),
    "straight down": ViaRegions.from_points([[1, 0, 0.8, 0, np.pi, 0]] * 2, [[0.1, 0.1, 0.1, 0.3, 0.4, 0.3]] * 2),
    "box": ViaRegions.from_box(6, [1.0, 0.0, 0.8], [0.5, 0.6, 0.4], [0.0, np.pi, 0.0], np.radians(30)),
    "tube": ViaRegions.from_tube(4, PATH, 0.05, 0.2),
    "envelope": ViaRegions.from_envelope(4, TASK, 0.05),
}
KINDS = st.sampled_from(sorted(REGIONS))


def inside(region, pose):
    """Whether the TCP is where the region's own numbers allow it, and its axis within the cone."""
    if isinstance(region, PointRegion):
        return bool(np.all(np.abs(pose[:3, 3] - region.middle[:3]) <= region.spread[:3] + 1e-9))
    if isinstance(region, BoxRegion):
        away, axis = np.abs(pose[:3, 3] - region.middle[:3, 3]) - region.half, region.middle[:3, 2]
    else:
        lengths = np.linspace(region.begin, region.end, 500)
        way = np.stack([np.interp(lengths, region.along, column) for column in region.points.T], axis=1)
        nearest = np.linalg.norm(way - pose[:3, 3], axis=1).min()
        away, axis = nearest - region.radius - 1e-4, None
    tilted = axis is not None and np.arccos(min(axis @ pose[:3, 2], 1.0)) > region.cone + 1e-6
    return bool(np.all(away <= 1e-9)) and not tilted


QUICK = settings(max_examples=100, deadline=None, derandomize=True)


@QUICK
@given(kind=KINDS, seed=st.integers(0, 2**32 - 1))
def test_every_genome_gives_poses_inside_its_regions(kind, seed):
    regions = REGIONS[kind]
    poses = regions.poses(np.random.default_rng(seed).random(regions.genes))
    assert poses.shape == (regions.count, 4, 4)
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3))
    for region, pose in zip(regions.regions, poses, strict=True):
        assert inside(region, pose)


@QUICK
@given(kind=st.sampled_from(["points", "box"]), point=st.integers(0, 1), axis=st.integers(0, 2))
def test_position_genes_map_linearly_to_the_region(kind, point, axis):
    regions = REGIONS[kind]

    def at(value):
        genome = np.full(regions.genes, 0.5)
        genome[6 * point + axis] = value
        return regions.poses(genome)

    low, middle, high = at(0.0), at(0.5), at(1.0)
    assert np.allclose(0.5 * (low + high)[point], middle[point])
    region = regions.regions[point]
    border = region.spread[axis] if kind == "points" else region.half[axis]
    moved = (high - middle)[point]
    assert np.isclose(moved[axis, 3], border)
    assert np.allclose(np.delete(moved.ravel(), 4 * axis + 3), 0.0)


@QUICK
@given(seed=st.integers(0, 2**32 - 1))
def test_the_cone_bounds_the_tilt_of_the_tool_axis(seed):
    regions = REGIONS["box"]
    genome = np.random.default_rng(seed).integers(0, 2, regions.genes)  # the corners are the worst
    tilt = np.arccos(np.clip(-regions.poses(genome)[:, 2, 2], -1, 1))
    assert np.max(tilt) <= np.radians(30) + 1e-9


def test_the_whole_cone_is_used():
    regions = REGIONS["box"]
    tilt = np.arccos(-regions.poses(np.tile([0.5, 0.5, 0.5, 1.0, 1.0, 0.5], 6))[:, 2, 2])
    assert np.allclose(tilt, np.radians(30))


def test_the_tube_follows_its_path():
    regions = REGIONS["tube"]
    middles = regions.poses(np.full(regions.genes, 0.5))[:, :3, 3]
    assert np.all(np.diff(middles[:, 1]) > 0)
    first = regions.poses(np.tile([0.0, 0.5, 0.5, 0.5, 0.5, 0.5], 4))[0]
    last = regions.poses(np.tile([1.0, 0.5, 0.5, 0.5, 0.5, 0.5], 4))[-1]
    assert np.allclose(first, PATH[0])
    assert np.allclose(last, PATH[2])


def test_the_envelope_contains_the_task_with_a_margin():
    regions = REGIONS["envelope"]
    travel = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(TASK[:, :3, 3], axis=0), axis=1))))
    part = np.minimum((4 * travel / travel[-1]).astype(int), 3)
    for pose, own in zip(TASK, part, strict=True):
        assert inside(regions.regions[own], pose)
    assert np.isclose(regions.poses(np.ones(regions.genes))[0, 2, 3], TASK[0, 2, 3] + 0.05)


def test_regions_can_be_pickled_and_refuse_invalid_genomes():
    for regions in REGIONS.values():
        again = pickle.loads(pickle.dumps(regions))
        genome = np.linspace(0, 1, regions.genes)
        assert np.array_equal(again.poses(genome), regions.poses(genome))
    with pytest.raises(InputError, match="36 numbers"):
        REGIONS["box"].poses(np.zeros(35))
    with pytest.raises(InputError, match="from 0 to 1"):
        REGIONS["box"].poses(np.full(36, 1.5))
    with pytest.raises(InputError, match="two different points"):
        ViaRegions.from_tube(3, PATH[:1] * 2, 0.1)
    with pytest.raises(InputError, match="does not move"):
        ViaRegions.from_envelope(3, PATH[:1] * 5, 0.1)
    with pytest.raises(InputError, match="range"):
        ViaRegions.from_points([[1, 0, 0.8, 0, 0, 0]], [[0.1] * 5])
