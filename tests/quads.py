"""A rectangle of two triangles."""

import torch

TWO = torch.tensor([[0, 1, 2], [0, 2, 3]])


def quad(left, right, bottom, top, z):
    return [[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]]
