import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""export.py WEIGHTS|thermal|day OUT NAME thermal?  -> onnx in our contract"""
import sys, torch, json

sys.path.insert(0, STUDENT)
import student as S
from sorvolo.lab.training.onnx_export import onnx_from_module


def detector(net, least=0.01):
    return S.CocoDetector(
        net.backbone, net.head, [[0], [1], [2]], S.CocoSettings(least_score=least)
    ).eval()


def export(net, out, name, thermal):
    info = {
        "name": name,
        "classes": ["person", "car", "small object"],
        "thresholds": {"person": 0.3, "car": 0.3, "small object": 0.3},
        "best_px": {
            "person": [12, 130],
            "car": [14, 220] if thermal else [40, 110],
            "small object": [10, 130],
        },
        "stride": 32,
        "thermal": thermal,
        "daylight": not thermal,
        "licence": "CC-BY-SA-4.0",
        "trained_on": "x",
        "on_request": ["small object"],
        "preset": "fast",
        "version": "0",
    }
    open(out, "wb").write(onnx_from_module(detector(net), info))


if __name__ == "__main__":
    src, out, name, th = sys.argv[1:5]
    if src in ("thermal", "day"):
        net = getattr(S, src)()
    else:
        net = S.Net(S.NanoDetBackbone(), S.FinerNanoDetHead(3))
        net.load_state_dict(
            {
                k: v.float()
                for k, v in torch.load(src, map_location="cpu", weights_only=True).items()
            }
        )
    export(net.eval(), out, name, th == "1")
    print(out)
