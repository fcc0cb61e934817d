import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""student's false reports on bare ground: places for hard negatives -> STUDENT/mined.json {path: [[cx,cy,side]]}"""
import sys, json
from pathlib import Path
import numpy as np, cv2, onnxruntime as ort

cv2.setNumThreads(1)
D = Path(DATA) / "flights"
o = ort.SessionOptions()
o.intra_op_num_threads = 1
s = ort.InferenceSession(STUDENT + "/a1_end.onnx", o, providers=["CPUExecutionProvider"])
out = {}
ps = [
    p
    for p in sorted((D / "caliterra").glob("*.[jJ][pP][gG]"))
    if "IMG_9354.jpg" <= p.name <= "IMG_9399.jpg"
][::2] + sorted((D / "fixed_wing").glob("*.[jJ][pP][gG]"))[::2]
for p in ps:
    im = cv2.imread(str(p))[..., ::-1]
    for sc in (0.5, 1.0):
        x = cv2.resize(im, None, fx=sc, fy=sc, interpolation=cv2.INTER_AREA)
        h, w = x.shape[:2]
        H, W = -(-h // 32) * 32, -(-w // 32) * 32
        q = np.full((1, 3, H, W), 114, np.uint8)
        q[0, :, :h, :w] = x.transpose(2, 0, 1)
        B, S, L = s.run(None, {"image": q})
        for b, c, l in zip(B, S, L):
            if c >= 0.15 and l < 2:
                out.setdefault(str(p), []).append(
                    [
                        *(float(v) / sc for v in ((b[0] + b[2]) / 2, (b[1] + b[3]) / 2)),
                        float(max(b[2] - b[0], b[3] - b[1])) / sc,
                        float(c),
                        int(l),
                    ]
                )
    print(p.name, len(out.get(str(p), [])), flush=True)
json.dump(out, open(STUDENT + "/mined.json", "w"))
