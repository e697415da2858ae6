"""Meshes, their subdivision and handles, and the targets of MESHFIT."""

import math
import struct
import sys

import numpy as np
import pytest
import trimesh
from quads import TWO, quad
from scipy.spatial import cKDTree

from experiments.problems.scenes import mesh_targets, stanford
from experiments.problems.scenes.icosphere import icosphere, split
from experiments.problems.scenes.meshes import vertex_normals
from experiments.problems.scenes.subdivision import bumps, smoothing, subdivision


@pytest.mark.parametrize("level", [0, 1, 3])
def test_icosphere(level) -> None:
    vertices, faces = icosphere(level)
    assert (len(vertices), len(faces)) == (10 * 4**level + 2, 20 * 4**level)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, rtol=1e-12)
    same = trimesh.creation.icosphere(level)  # turned, and in another order
    lengths = np.sort(trimesh.Trimesh(vertices, faces, process=False).edges_unique_length)
    np.testing.assert_allclose(lengths, np.sort(same.edges_unique_length), rtol=1e-9)
    edges = {tuple(edge) for face in faces for edge in (face[[0, 1]], face[[1, 2]], face[[2, 0]])}
    assert len(edges) == 3 * len(faces)  # each once in each direction: closed and consistently wound
    assert all((b, a) in edges for a, b in edges)
    assert bool((np.linalg.det(vertices[faces]) > 0).all())
    if level:
        np.testing.assert_array_equal(icosphere(level - 1)[0], vertices[: 10 * 4 ** (level - 1) + 2])
    with pytest.raises(ValueError, match="level must be at least 0"):
        icosphere(-1)


def test_subdivision_has_the_weights_of_loop() -> None:
    vertices, faces = icosphere(1)  # vertices of 5 neighbours, and of 6, whose limit is regular
    matrix, (_, ends) = subdivision(faces, len(vertices)).toarray(), split(faces, len(vertices))
    neighbours = [set(faces[(faces == i).any(1)].ravel()) - {i} for i in range(len(vertices))]
    for i, row in enumerate(matrix[: len(vertices)]):
        k = len(neighbours[i])
        beta = {5: (5 / 8 - (3 / 8 + math.cos(2 * math.pi / 5) / 4) ** 2) / 5, 6: 1 / 16}[k]
        expected = np.zeros(len(vertices))
        expected[list(neighbours[i])] = beta
        expected[i] = 1 - k * beta
        np.testing.assert_allclose(row, expected, atol=1e-15)
    for (a, b), row in zip(ends, matrix[len(vertices) :], strict=True):
        expected = np.zeros(len(vertices))
        expected[[a, b]] = 3 / 8
        expected[list(neighbours[a] & neighbours[b])] = 1 / 8
        np.testing.assert_allclose(row, expected, atol=1e-15)


def test_subdivision_is_that_of_trimesh() -> None:
    vertices, faces = icosphere(2)
    rough = vertices * (1 + 0.1 * np.sin(5 * vertices[:, :1]))
    expected, _ = trimesh.remesh.subdivide_loop(rough, faces, iterations=1)
    found = subdivision(faces, len(vertices)) @ rough
    np.testing.assert_allclose(found[: len(vertices)], expected[: len(vertices)], atol=1e-12)
    # The old vertices come first in both. The new ones have another order in trimesh.
    distance, match = cKDTree(found).query(expected)
    assert distance.max() < 1e-12
    assert sorted(match) == list(range(len(found)))


def test_bumps_are_a_partition_of_unity_around_their_handles() -> None:
    fine, _ = icosphere(3)
    for coarse in (0, 1, 2, 3):
        handles, faces = icosphere(coarse)
        matrix = bumps(coarse, 3).toarray()
        assert matrix.shape == (len(fine), len(handles))
        np.testing.assert_allclose(matrix.sum(1), 1.0)
        assert bool((matrix >= 0).all())
        assert matrix[np.arange(len(handles)), np.arange(len(handles))].min() > 0.4
        centre = matrix.T @ fine
        cosine = (centre * handles).sum(1) / np.linalg.norm(centre, axis=1)
        assert cosine.min() > 0.999
    np.testing.assert_array_equal(bumps(3, 3).toarray(), smoothing(faces, len(handles)).toarray())
    with pytest.raises(ValueError, match="coarse must be between 0 and fine = 1, got 2"):
        bumps(2, 1)


def ply(header: str, vertices, faces) -> bytes:
    body = b"".join(struct.pack("<3f", *v) for v in vertices) + b"".join(struct.pack("<B3i", 3, *f) for f in faces)
    return header.encode() + b"end_header\n" + body


HEADER = (
    "ply\nformat binary_little_endian 1.0\nobj_info made by hand\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\nelement face 2\nproperty list uchar int vertex_indices\n"
)


def test_read_ply(tmp_path) -> None:
    path = tmp_path / "square.ply"
    square = quad(0.0, 1.0, 0.0, 2.0, 0.5)
    path.write_bytes(ply(HEADER, square, TWO.tolist()))
    vertices, faces = stanford.read_ply(path)
    np.testing.assert_array_equal(vertices, square)
    np.testing.assert_array_equal(faces, TWO.numpy())


def volume(vertices, faces) -> float:
    return float(np.linalg.det(vertices[faces]).sum() / 6)


def test_cluster_keeps_the_shape() -> None:
    vertices, faces = icosphere(5)
    merged, left = stanford.cluster(vertices, faces, 0.1)
    assert len(merged) < 0.4 * len(vertices)
    assert set(left.ravel()) == set(range(len(merged)))
    assert len(np.unique(np.sort(left, axis=1), axis=0)) == len(left)
    assert volume(merged, left) == pytest.approx(volume(vertices, faces), rel=0.02)
    a, b, c = (merged[left[:, k]] for k in range(3))
    assert bool(((np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all())


@pytest.mark.parametrize("source", ["pymeshfix", "procedural"])
def test_bunny(source, monkeypatch) -> None:
    if source == "procedural":
        monkeypatch.setattr(stanford, "_scan", lambda: None)
    (vertices, normals, faces), found = stanford.bunny_surface()
    assert found == source
    assert faces.dtype == np.uint32
    assert int(faces.max()) == len(vertices) - 1
    np.testing.assert_allclose(vertices.min(0) + vertices.max(0), 0.0, atol=1e-12)
    assert np.ptp(vertices[:, 1]) == pytest.approx(1.0)
    assert 0.3 < np.ptp(vertices[:, 2]) <= np.ptp(vertices[:, 0]) < 1.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert 0.08 < volume(vertices, faces) < 0.4  # positive: wound outward
    np.testing.assert_allclose(normals, vertex_normals(vertices, faces))
    assert np.mean((normals * vertices).sum(1) > 0) > 0.7
    # Ears: the upper fifth is thin.
    assert 0.0 < np.mean(vertices[:, 1] > 0.3) < 0.2


def test_a_scan_that_is_not_installed_is_not_found(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshfix", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert stanford._scan() is None


def edges_of(faces) -> list[tuple[int, int]]:
    return [tuple(edge) for face in faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)]


@pytest.mark.parametrize("make", [mesh_targets.suzanne, mesh_targets.banana])
def test_targets_of_the_source_are_closed_and_wound_outward(make, monkeypatch) -> None:
    monkeypatch.setattr(mesh_targets, "_blender", lambda: None)
    found = make()
    assert found.source == "procedural"
    assert set(found.faces.ravel()) == set(range(len(found.vertices)))
    edges = edges_of(found.faces)
    assert len(set(edges)) == len(edges)  # each once in each direction
    assert {(b, a) for a, b in edges} == set(edges)
    np.testing.assert_allclose(found.vertices.min(0) + found.vertices.max(0), 0.0, atol=1e-12)
    assert np.ptp(found.vertices, axis=0).max() == pytest.approx(1.0)
    assert volume(found.vertices, found.faces) > 0.01
    # Euler: a sphere, no holes and no handles.
    assert len(found.vertices) - len(edges) // 2 + len(found.faces) == 2


def test_a_banana_is_bent_thin_and_has_three_colours() -> None:
    found = mesh_targets.banana()
    assert found.colors.shape == found.vertices.shape
    assert 0 < found.colors.min() < found.colors.max() < 1
    x, y, z = found.vertices.T
    assert np.ptp(z) < 0.35 * np.ptp(x)
    middle, ends = np.abs(x) < 0.05, np.abs(x) > 0.45
    assert y[middle].mean() + 0.1 < min(y[ends & (x < 0)].mean(), y[ends & (x > 0)].mean())
    brown = found.colors[:, 0] < 0.4
    assert np.abs(x[brown]).min() > 0.35
    green = found.colors[:, 1] > found.colors[:, 0]
    assert 0.02 < green.mean() < 0.3


def test_suzanne_is_that_of_blender_where_it_is_installed(monkeypatch) -> None:
    square = np.array(quad(0.0, 3.0, 0.0, 1.0, 0.0))
    monkeypatch.setattr(mesh_targets, "_blender", lambda: (square, TWO.numpy()))
    found = mesh_targets.suzanne()
    assert (found.name, found.source) == ("Suzanne", "bpy")
    assert np.ptp(found.vertices, axis=0) == pytest.approx([1.0, 1 / 3, 0.0])
