import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""Build NanoDet students from packaged models' weights."""
import onnx, numpy as np, torch, json
from onnx import numpy_helper as H
from sorvolo.lab.training.nanodet import *

DATA = MODELS


def weights(name):
    m = onnx.load(DATA + name + ".onnx")
    return {
        i.name.replace("_half", ""): torch.from_numpy(H.to_array(i).astype(np.float32).copy())
        for i in m.graph.initializer
    }


def sub(w, prefix):
    return {k[len(prefix) :]: v for k, v in w.items() if k.startswith(prefix)}


class Net(torch.nn.Module):
    def __init__(s, b, h):
        super().__init__()
        s.backbone, s.head = b, h

    def forward(s, x):
        return s.head(s.backbone(x))


def thermal():
    w = weights("thermal")
    n = Net(NanoDetBackbone(), FinerNanoDetHead(3))
    sd = sub(w, "coco.")
    miss = n.load_state_dict(sd, strict=False)
    print("thermal", miss.missing_keys, [k for k in miss.unexpected_keys][:8])
    return n


def day():
    w = weights("default")
    t = sub(weights("thermal"), "coco.")
    n = Net(NanoDetBackbone(), FinerNanoDetHead(3))
    own = n.state_dict()
    for k, v in sub(w, "coco.backbone.").items():
        own["backbone." + k] = v
    people, coco = sub(w, "people."), sub(w, "coco.head.")
    for k, v in people.items():
        if k.startswith("outputs."):
            c = coco[k]
            v = torch.cat([v[:1], c[2:3], c[32:33], v[1:]])
        assert own["head.coarse." + k].shape == v.shape, (k, v.shape)
        own["head.coarse." + k] = v
    for k, v in t.items():
        if k.startswith("head.fine"):
            own[k] = v
    own["head.fine_output.bias"][:3] = -4.6
    n.load_state_dict(own)
    return n
