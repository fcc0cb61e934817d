import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
import sys, pickle, numpy as np, cv2, glob
from pathlib import Path
from sorvolo.detection.quantise import quantise

src, out = sys.argv[1:3]
parts = tuple(a for a in sys.argv[3:] if a != "none")
ims = []
for f in sorted(glob.glob(STUDENT + "/pool2/*.pkl"))[:4]:
    for t in pickle.load(open(f, "rb"))[:16]:
        ims.append(np.ascontiguousarray(cv2.imdecode(np.frombuffer(t[0], np.uint8), 1)[..., ::-1]))
r = quantise(Path(src), ims, float_parts=parts)
open(out, "wb").write(r.model)
print(len(r.model), r.convolutions, r.of)
