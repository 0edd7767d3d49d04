"""What a photo shows of a surface fades into the prior around it."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from oasis_warp.adaptation.inpainting import FADE_LENGTH, inpaint, laplacian_and_mass


def hand_sized_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces))


def test_what_is_seen_is_kept_and_what_is_far_from_it_is_the_prior():
    vertices, faces = hand_sized_sphere()
    seen = (vertices[:, 2] > 0).double()
    field = inpaint(vertices, faces, torch.full((len(vertices), 1), 0.3, dtype=torch.float64), seen)
    assert float(field[vertices[:, 2] > 0.01].min()) > 0.29
    assert float(field[vertices[:, 2] < -0.045].abs().max()) < 0.3 * np.exp(-0.05 / FADE_LENGTH) * 3


def test_there_is_no_step_at_the_border_of_the_seen_region():
    vertices, faces = hand_sized_sphere()
    seen = (vertices[:, 2] > 0).double()
    field = inpaint(vertices, faces, torch.full((len(vertices), 1), 0.3, dtype=torch.float64), seen)[:, 0]
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert float((field[edges[:, 0]] - field[edges[:, 1]]).abs().max()) < 0.05


def test_the_field_never_leaves_the_range_of_what_was_seen():
    vertices, faces = hand_sized_sphere()
    generator = torch.Generator().manual_seed(0)
    observed = torch.rand(len(vertices), 3, generator=generator, dtype=torch.float64)
    field = inpaint(vertices, faces, observed, (vertices[:, 0] > 0).double())
    assert float(field.min()) > -1e-3
    assert float(field.max()) < 1


def test_nothing_seen_is_nothing_added():
    vertices, faces = hand_sized_sphere()
    field = inpaint(vertices, faces, torch.ones(len(vertices), 3), torch.zeros(len(vertices)))
    assert float(field.abs().max()) == 0


def test_laplacian_and_mass_are_those_of_libigl(hand):
    points, triangles = hand.template.double().numpy(), hand.faces.numpy()
    laplacian, mass = laplacian_and_mass(points, triangles)
    # libigl works on squared lengths and loses digits on slivers, whose cotangents are large
    assert abs(laplacian + igl.cotmatrix(points, triangles)).max() < 1e-6 * abs(laplacian).max()
    theirs = igl.massmatrix(points, triangles, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    assert mass == pytest.approx(theirs, rel=1e-9)
