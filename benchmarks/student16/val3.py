import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""val3.py MODEL.onnx: AP50 on sets no training saw; false reports on val photos and on clutter, at thresholds"""
import sys, json, pickle

ARGS = list(sys.argv)
src = open(STUDENT + "/val.py").read().rsplit("\nif __name__", 1)[0]
sys.argv = ["v"]
exec(compile(src, "val.py", "exec"))


def ground_val():
    f = Path(STUDENT + "/groundval.pkl")
    if f.exists():
        return pickle.load(open(f, "rb"))
    rows = []
    for p in [
        *P.ground(DATA, "caliterra", "IMG_9390.jpg", "IMG_9399.jpg").pictures,
        *P.ground(DATA, "fixed_wing").pictures[:8],
    ]:
        im = cv2.imread(p.path)
        im = cv2.resize(im, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)[..., ::-1]
        rows.append(
            (
                np.ascontiguousarray(im),
                np.zeros((0, 4)),
                np.zeros(0, int),
                np.zeros((0, 4)),
                (1, 1, 0),
            )
        )
    out = {"ground": rows}
    g = {}
    m = open(STUDENT + "/make3.py").read().rsplit("\nmain3()", 1)[0]
    ns = {"__name__": "m"}
    sys.argv = ["m", "x", "0", "0", "0"]
    exec(compile(m, "make3.py", "exec"), ns)
    clut = read_scenes(Path(STUDENT + "/clutter_val"))
    rng = np.random.default_rng(9)
    rows = []
    from painted_grounds import painted_ground

    gr = P.ground(DATA, "caliterra", "IMG_9390.jpg", "IMG_9399.jpg")
    share = Share(gr, 1.0, (0.5, 2.0))
    ns["SIDE"] = 640
    for k in range(60):
        p = gr.pictures[k % 10]
        im = np.ascontiguousarray(cv2.imread(p.path)[..., ::-1])
        if k % 2:
            im = np.ascontiguousarray(painted_ground(im, np.random.default_rng((k, 4321))))
        s = cut_sample(im, p, share, CLASSES, replace(P._PLAIN, side_px=640), rng)
        sh = P.Shown(s.image, np.zeros((0, 4)), np.zeros((0, 4)))
        for _ in range(2):
            sh = ns["clutter"](sh, clut[int(rng.integers(len(clut)))], rng)
        rows.append(
            (
                P.finished(sh.image, rng),
                np.zeros((0, 4)),
                np.zeros(0, int),
                np.zeros((0, 4)),
                (1, 1, 0),
            )
        )
    out["clutter"] = rows
    pickle.dump(out, open(f, "wb"))
    return out


def run(model):
    o = ort.SessionOptions()
    o.intra_op_num_threads = 1
    s = ort.InferenceSession(model, o, providers=["CPUExecutionProvider"])

    def see(im):
        h, w = im.shape[:2]
        H, W = -(-h // 32) * 32, -(-w // 32) * 32
        x = np.full((1, 3, H, W), 114, np.uint8)
        x[0, :, :h, :w] = im.transpose(2, 0, 1)
        return s.run(None, {s.get_inputs()[0].name: x})

    pairs = {c: [] for c in range(3)}
    n = {}
    sets = {**cached(), **ground_val()}
    sets["tiny2"] = [
        (
            cv2.resize(im, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR),
            np.asarray(b) * 2.0,
            l,
            np.asarray(ig) * 2.0,
            kn,
        )
        for im, b, l, ig, kn in sets.pop("tinyperson_val")
    ]
    for name, rows in sets.items():
        for im, b, l, ig, kn in rows:
            B, S, L = see(im)
            for c in range(3):
                if not kn[c]:
                    continue
                t = np.asarray(b, float).reshape(-1, 4)[np.asarray(l) == c]
                n[name, c] = n.get((name, c), 0) + len(t)
                used = np.zeros(len(t), bool)
                ii = np.nonzero(L == c)[0]
                ii = ii[np.argsort(-S[ii])]
                if not len(ii):
                    continue
                ov = iou(B[ii], t)[0] if len(t) else None
                igb = np.asarray(ig, float).reshape(-1, 4)
                cov = iou(B[ii], igb)[1].max(1, initial=0) if len(igb) else np.zeros(len(ii))
                for k, i in enumerate(ii):
                    fr = np.where(used, 0, ov[k]) if len(t) else np.zeros(0)
                    if len(fr) and fr.max() >= 0.5:
                        used[fr.argmax()] = True
                        pairs[c].append((float(S[i]), 1, name))
                    elif cov[k] > 0.5:
                        continue
                    else:
                        pairs[c].append((float(S[i]), 0, name))
    return pairs, n, {k: len(v) for k, v in {**cached(), **ground_val()}.items()}


def ap(hh, n):
    hh = sorted(hh, reverse=True)
    x = np.array([h[1] for h in hh])
    if not len(hh) or not n:
        return float("nan")
    r = np.cumsum(x) / n
    p = np.cumsum(x) / np.arange(1, len(x) + 1)
    p = np.maximum.accumulate(p[::-1])[::-1]
    return float(np.sum(np.diff(np.concatenate([[0], r])) * p))


def report(pairs, n, pics):
    for (name, c), k in n.items():
        if k:
            print(
                name,
                CLASSES[c],
                k,
                "AP50 %.3f" % ap([p for p in pairs[c] if p[2] == name], k),
                end="; ",
            )
    print()
    for c in (0, 1):
        # at the score where recall on labelled val sets is r: false per picture on ground and clutter
        lab = [p for p in pairs[c] if n.get((p[2], c), 0) and p[2] != "tiny2"]
        N = sum(v for (nm, cc), v in n.items() if cc == c and nm != "tiny2")
        right = sorted([p[0] for p in lab if p[1]], reverse=True)
        for r in (0.2, 0.3, 0.4, 0.5, 0.6) if c == 0 else (0.6, 0.7, 0.8, 0.85):
            k = int(r * N)
            if k >= len(right):
                break
            t = right[k]
            fp = {
                nm: sum(p[0] >= t and not p[1] and p[2] == nm for p in pairs[c]) / pics[nm]
                for nm in ("ground", "clutter")
            }
            pr = sum(p[0] >= t and p[1] for p in lab) / max(1, sum(p[0] >= t for p in lab))
            print(
                CLASSES[c],
                "recall",
                r,
                "score %.3f precision %.2f false/picture ground %.2f clutter %.2f"
                % (t, pr, fp["ground"], fp["clutter"]),
            )


if __name__ == "__main__":
    r = run(ARGS[1])
    pickle.dump(r, open(STUDENT + "/pairs3.pkl" if len(ARGS) < 3 else ARGS[2], "wb"))
    report(*r)
