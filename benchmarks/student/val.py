import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""val.py MODEL.onnx [hist]: AP50 on fit sets that no training saw (tinyperson val, rendered on fixed_wing, simulated val) and raw (score,right) pairs"""
import sys, json, pickle
from pathlib import Path
import numpy as np, cv2, onnxruntime as ort

sys.path.insert(0, RECIPES)
sys.argv, argv = [sys.argv[0]], sys.argv
import importlib.util
from dataclasses import replace
import people_samples as P
from detection_data import tinyperson, in_order, SMALL
from rendered_people import read_scenes
from sorvolo.lab.training.samples import Share, cut_sample
from sorvolo.lab.datasets import read_dataset
from sorvolo.survey.objects import CLASSES

DATA = Path(DATA) / "detection"


def sets():
    out = {}
    tp = tinyperson(DATA)["val"]
    out["tinyperson_val"] = [
        (cv2.imread(p.path)[..., ::-1], p.boxes_px, p.labels, p.ignored_px, (1, 0, 0))
        for p in tp.pictures
    ]
    scenes = read_scenes(Path(STUDENT + "/scenes_val"))
    fw = P.ground(DATA, "caliterra", "IMG_9354.jpg", "IMG_9399.jpg")
    rng = np.random.default_rng(5)
    share = Share(fw, 1.0, (0.5, 2.0))
    rows = []
    cache = {p.path: np.ascontiguousarray(cv2.imread(p.path)[..., ::-1]) for p in fw.pictures}
    for k in range(75):
        p = fw.pictures[k % len(fw.pictures)]
        from painted_grounds import painted_ground

        made = np.ascontiguousarray(painted_ground(cache[p.path], np.random.default_rng((k, 1234))))
        s = cut_sample(made, p, share, CLASSES, replace(P._PLAIN, side_px=640), rng)
        sh = P.Shown(
            s.image, s.boxes.astype(float).reshape(-1, 4), s.ignored.astype(float).reshape(-1, 4)
        )
        if k % 3:
            sh = P.pasted(sh, scenes[k % len(scenes)], rng)
        rows.append(
            (
                P.finished(sh.image, rng),
                sh.boxes,
                np.zeros(len(sh.boxes), int),
                sh.ignored,
                (1, 1, 0),
            )
        )
    out["rendered_val"] = rows
    sim = in_order(read_dataset(Path(STUDENT + "/simulated_val")))
    out["sim_val"] = [
        (cv2.imread(p.path)[..., ::-1], p.boxes_px, p.labels, p.ignored_px, (1, 1, 1))
        for p in sim.pictures
    ]
    return out


def cached():
    f = Path(STUDENT + "/valsets.pkl")
    if not f.exists():
        pickle.dump(sets(), open(f, "wb"))
    return pickle.load(open(f, "rb"))


def iou(a, b):
    lo = np.maximum(a[:, None, :2], b[None, :, :2])
    hi = np.minimum(a[:, None, 2:], b[None, :, 2:])
    i = np.clip(hi - lo, 0, None).prod(2)
    return i / np.maximum(
        (a[:, 2:] - a[:, :2]).prod(1)[:, None] + (b[:, 2:] - b[:, :2]).prod(1)[None] - i, 1e-9
    ), i / np.maximum((a[:, 2:] - a[:, :2]).prod(1)[:, None], 1e-9)


def main(model):
    o = ort.SessionOptions()
    o.intra_op_num_threads = 1
    s = ort.InferenceSession(model, o, providers=["CPUExecutionProvider"])
    res = {}
    pairs = {c: [] for c in range(3)}
    for name, rows in cached().items():
        for c in range(3):
            pass
        hits = {c: [] for c in range(3)}
        n = dict.fromkeys(range(3), 0)
        for im, b, l, ig, kn in rows:
            h, w = im.shape[:2]
            H, W = -(-h // 32) * 32, -(-w // 32) * 32
            x = np.full((1, 3, H, W), 114, np.uint8)
            x[0, :, :h, :w] = im.transpose(2, 0, 1)
            B, S, L = s.run(None, {"image": x})
            for c in range(3):
                if not kn[c]:
                    continue
                t = np.asarray(b, float).reshape(-1, 4)[np.asarray(l) == c]
                n[c] += len(t)
                used = np.zeros(len(t), bool)
                ii = np.nonzero(L == c)[0]
                ii = ii[np.argsort(-S[ii])]
                if not len(ii):
                    continue
                ov, _ = iou(B[ii], t) if len(t) else (np.zeros((len(ii), 0)), 0)
                igb = np.vstack([np.asarray(ig, float).reshape(-1, 4)])
                cov = iou(B[ii], igb)[1].max(1, initial=0) if len(igb) else np.zeros(len(ii))
                for k, i in enumerate(ii):
                    free = np.where(used, 0, ov[k]) if len(t) else np.zeros(0)
                    if len(free) and free.max() >= 0.5:
                        used[free.argmax()] = True
                        hits[c].append((S[i], 1))
                    elif cov[k] > 0.5:
                        continue
                    else:
                        hits[c].append((S[i], 0))
        for c in range(3):
            if not n[c]:
                if hits[c]:
                    pairs[c] += [(float(a), 0, name) for a, _ in hits[c]]
                continue
            hh = sorted(hits[c], reverse=True)
            r = np.cumsum([x for _, x in hh]) / n[c]
            p = np.cumsum([x for _, x in hh]) / np.arange(1, len(hh) + 1)
            p = np.maximum.accumulate(p[::-1])[::-1]
            ap = float(np.sum(np.diff(np.concatenate([[0], r])) * p)) if len(hh) else 0
            res[f"{name}:{CLASSES[c]}"] = (n[c], round(ap, 3))
            pairs[c] += [(float(a), int(x), name) for a, x in hits[c]]
    print(json.dumps(res))
    pickle.dump(pairs, open(STUDENT + "/pairs.pkl", "wb"))


if __name__ == "__main__":
    main(argv[1])
