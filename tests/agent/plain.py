"""The networks in plain PyTorch, from their weights by name; those of encoders have a prefix."""

import torch
import torch.nn.functional as F


def encode(weights, prefix, maps):
    """Nature encoders on plain maps, concatenated."""
    embeddings = []
    for i, x in enumerate(maps):
        w = {k.removeprefix(f"{prefix}.encoders.{i}."): v for k, v in weights.items()}
        x = F.leaky_relu(F.conv2d(x, w["conv1.weight"], w["conv1.bias"], 4))
        x = F.leaky_relu(F.conv2d(x, w["conv2.weight"], w["conv2.bias"], 2))
        x = F.leaky_relu(F.conv2d(x, w["conv3.weight"], w["conv3.bias"]))
        x = x.permute(0, 2, 3, 1).flatten(1)
        embeddings.append(F.leaky_relu(F.linear(x, w["linear.weight"], w["linear.bias"])))
    return torch.cat(embeddings, 1)


def head(weights, prefix, x, net=...):
    w = {k: weights[f"{prefix}.{k}"][net] for k in
         ("hidden.weight", "hidden.bias", "output.weight", "output.bias")}  # fmt: skip
    x = F.linear(x, w["hidden.weight"], w["hidden.bias"])
    return F.linear(x * torch.sigmoid(x), w["output.weight"], w["output.bias"])
