import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""make.py FIRST COUNT: shards of day samples -> STUDENT/pool2/NNNN.pkl (100 samples each)"""
import sys, pickle, os, time
from dataclasses import replace
from pathlib import Path
import cv2, numpy as np

cv2.setNumThreads(1)
sys.path.insert(0, RECIPES)
import people_samples as P
from detection_data import SMALL, aerial_cars, hituav, mannequin, tinyperson, in_order
from drawn_stones import with_stones
from rendered_people import read_scenes
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.training.samples import Augmentation, Sample, Share, cut_sample
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

DATA = Path(DATA) / "detection"
SIDE = 384
NOTHUMAN = frozenset({SMALL})


def maybe_people(labelled, file):
    """COCO people regions of the teacher run, to ignore for persons"""
    return labelled


class Src:
    def __init__(s, share, pasted, seen=None, least_px=0.0, cars=0.0):
        s.share, s.pasted, s.seen, s.least_px, s.cars = (
            share,
            pasted,
            seen or (lambda p, r: p),
            least_px,
            cars,
        )


def teacher(labelled, table):
    """car boxes >=.5 as labels, .1-.5 ignored; people >=.1 ignored"""
    out = []
    for p in labelled.pictures:
        t = table[Path(p.path).name]
        b = np.array([d[:4] for d in t], np.float32).reshape(-1, 4)
        sc = np.array([d[4] for d in t])
        lb = np.array([d[5] for d in t], int)
        car = (lb == 1) & (sc >= 0.5)
        ign = (sc >= 0.1) & ~car
        out.append(
            LabelledPicture(
                p.path,
                p.width_px,
                p.height_px,
                p.group,
                b[car],
                np.ones(car.sum(), np.int64),
                b[ign],
            )
        )
    return labelled.only(out)


def plan(sim, table):
    site = P.ground(DATA, "caliterra", "IMG_9354.jpg", "IMG_9399.jpg")
    cars = aerial_cars(DATA)["train"]
    cars = cars.only(
        [
            replace(
                p,
                ignored_px=np.vstack(
                    [
                        p.ignored_px.reshape(-1, 4),
                        np.array(
                            [d[:4] for d in table[Path(p.path).name] if d[5] == 0 and d[4] >= 0.1],
                            np.float32,
                        ).reshape(-1, 4),
                    ]
                ),
            )
            for p in cars.pictures
        ]
    )
    cars = replace(cars, unlabelled=frozenset({SMALL}))
    th = hituav(DATA)["train"]
    th = th.only([p for p in th.pictures if len(p.labels)])
    painted = replace(P.ground(DATA, "caliterra", "IMG_9354.jpg", "IMG_9399.jpg"), name="painted")
    return [
        Src(Share(site, 1.6, (0.3, 2.6), pastes=SMALL), 0.75, cars=0.35),
        Src(Share(P.ground(DATA, "fixed_wing"), 1.4, (0.4, 3.0), pastes=SMALL), 0.6, cars=0.4),
        Src(Share(cars, 3.2, (0.3, 3.2)), 0.6, cars=0.2),
        Src(Share(sim, 2.0, (0.6, 3.0)), 0.4),
        Src(Share(tinyperson(DATA)["train"], 1.6, (1.0, 3.0), aslant=True, pastes=SMALL), 0.3),
        Src(Share(mannequin(DATA)["train"], 0.6, (0.35, 1.2), pastes=SMALL), 0.5, cars=0.3),
        Src(Share(th, 1.4, (1.2, 3.0)), 0.2, P.by_day, 14.0),
        Src(Share(painted, 1.6, (0.5, 2.0)), 0.6, P.Painted(), cars=0.6),
    ]


def car_cuts():
    import photo_cutouts as C

    out = []
    for p in aerial_cars(DATA)["train"].pictures:
        im = cv2.imread(p.path)[..., ::-1]
        for box in np.asarray(p.boxes_px, float)[p.labels == 1]:
            w = box[2:] - box[:2]
            if (
                max(w) < 40
                or min(box[0], box[1]) < 8
                or box[2] > im.shape[1] - 8
                or box[3] > im.shape[0] - 8
            ):
                continue
            m = 0.25 * w
            l, t = (box[:2] - m).clip(0).astype(int)
            r, b = (box[2:] + m).astype(int)
            part = np.ascontiguousarray(im[t:b, l:r])
            f = min(1, 160 / max(part.shape[:2]))
            part = cv2.resize(part, None, fx=f, fy=f, interpolation=cv2.INTER_AREA)
            mask = np.full(part.shape[:2], cv2.GC_BGD, np.uint8)
            x0, y0 = ((box[:2] - (l, t)) * f).astype(int)
            x1, y1 = ((box[2:] - (l, t)) * f).astype(int)
            mask[y0:y1, x0:x1] = cv2.GC_PR_FGD
            try:
                cv2.grabCut(
                    part, mask, None, np.zeros((1, 65)), np.zeros((1, 65)), 4, cv2.GC_INIT_WITH_MASK
                )
            except cv2.error:
                continue
            fg = ((mask == 1) | (mask == 3)).astype(np.uint8)
            n, lab, st, _ = cv2.connectedComponentsWithStats(fg)
            if n < 2:
                continue
            k = 1 + int(st[1:, 4].argmax())
            area = st[k, 4]
            bx = (x1 - x0) * (y1 - y0)
            if (
                not 0.35 < area / bx < 0.97
                or st[k, 2] < 0.8 * (x1 - x0)
                or st[k, 3] < 0.8 * (y1 - y0)
            ):
                continue
            a = cv2.GaussianBlur((lab == k).astype(np.float32), (0, 0), 0.7)
            cut = np.dstack([part.astype(np.float32) * a[..., None], a * 255, np.zeros_like(a)])
            sh = np.roll(a, (6, 6), (0, 1))
            cut[..., 4] = np.clip(sh - a, 0, 1) * 255 * float(0.5)
            out.append((cut, max(st[k, 2:4])))
    return out


def paste_cars(s, cuts, rng, read_px):
    """s: Sample; paste cars of one scale"""
    im = s.image.astype(np.float32)
    own = np.zeros(im.shape[:2], np.int32)
    areas = {}
    size = float(np.exp(rng.uniform(np.log(24), np.log(300))))
    light = np.stack(
        [
            np.full(3, np.exp(rng.normal(0, 0.2)) * rng.uniform(0.8, 1.05)),
            np.full(3, rng.uniform(0, 12)),
        ]
    )
    boxes, hidden = [], []
    rows = rng.random() < 0.4
    ang0 = rng.uniform(0, 360)
    c0 = rng.uniform(0.1, 0.9, 2) * SIDE
    for i in range(int(rng.integers(1, 7))):
        cut, l = cuts[int(rng.integers(len(cuts)))]
        f = size / l * rng.uniform(0.92, 1.08)
        ang = ang0 + rng.normal(0, 3) if rows else rng.uniform(0, 360)
        h, w = cut.shape[:2]
        D = int(np.hypot(h, w) * f) + 4
        M = cv2.getRotationMatrix2D((w / 2, h / 2), ang, f)
        M[:, 2] += D / 2 - np.array([w, h]) / 2
        src = cut if f > 0.7 else None
        if src is None:
            src = np.dstack(
                [
                    cv2.resize(c, None, fx=f * 1.2, fy=f * 1.2, interpolation=cv2.INTER_AREA)
                    for c in (np.ascontiguousarray(cut[..., :4]), np.ascontiguousarray(cut[..., 4]))
                ]
            )
            M = cv2.getRotationMatrix2D((src.shape[1] / 2, src.shape[0] / 2), ang, 1 / 1.2)
            M[:, 2] += D / 2 - np.array(src.shape[1::-1]) / 2
        turned = np.dstack(
            [cv2.warpAffine(src[..., :4], M, (D, D)), cv2.warpAffine(src[..., 4], M, (D, D))]
        )
        turned = P.softened(turned, max(0, rng.normal(0.3, 0.4)))
        step = np.radians(ang0) + np.pi / 2
        centre = (
            c0 + i * size * 0.62 * np.array([np.cos(step), np.sin(step)]) * (1 if rows else 0)
            if rows
            else rng.uniform(-0.02, 1.02, 2) * SIDE
        )
        corner = np.round(centre - np.array(turned.shape[1::-1]) / 2).astype(int)
        al = turned[..., 3] > 127
        ys, xs = np.nonzero(al)
        if not len(ys):
            continue
        bx = np.array([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1], float) + np.tile(corner, 2)
        olds = np.vstack(
            [
                s.boxes.reshape(-1, 4),
                np.array(boxes).reshape(-1, 4),
                np.array(hidden).reshape(-1, 4),
            ]
        )
        iw = np.minimum(bx[2], olds[:, 2]) - np.maximum(bx[0], olds[:, 0])
        ih = np.minimum(bx[3], olds[:, 3]) - np.maximum(bx[1], olds[:, 1])
        inter = np.clip(iw, 0, None) * np.clip(ih, 0, None)
        if rows:
            if (inter > 0.35 * (bx[2] - bx[0]) * (bx[3] - bx[1])).any():
                continue
            if (
                own[
                    np.clip(ys + corner[1], 0, SIDE - 1), np.clip(xs + corner[0], 0, SIDE - 1)
                ].mean()
                > 0.05
            ):
                continue
        elif (inter > 0).any():
            continue
        P.laid(im, own, turned, corner, 1, light, rng.uniform(0.2, 0.8))
        cutb = bx.clip(0, SIDE)
        share = np.prod(np.clip(cutb[2:] - cutb[:2], 0, None)) / np.prod(bx[2:] - bx[:2])
        (boxes if share >= 0.4 else hidden).append(cutb)
    boxes, hidden = (np.array(b).reshape(-1, 4) for b in (boxes, hidden))
    return Sample(
        np.clip(im, 0, 255).astype(np.uint8),
        np.vstack([s.boxes, boxes]),
        np.append(s.labels, np.ones(len(boxes), np.int64)),
        np.vstack([s.ignored, hidden]),
        s.known,
    )


def sample(src, scenes, cuts, read, rng, textures):
    pics = src.share.labelled.pictures
    plain = replace(P._PLAIN, side_px=SIDE)
    while True:
        p = pics[int(rng.integers(len(pics)))]
        s = cut_sample(src.seen(read(p.path), rng), p, src.share, CLASSES, plain, rng)
        if not src.least_px or len(s.boxes) or rng.random() < 0.15:
            break
    if src.least_px:
        small = ((s.boxes[:, 2:] - s.boxes[:, :2]).max(1, initial=0) < src.least_px) & (
            s.labels == 0
        )
        s = Sample(
            s.image,
            s.boxes[~small],
            s.labels[~small],
            np.vstack([s.ignored, s.boxes[small]]),
            s.known,
        )
    if src.cars and rng.random() < src.cars:
        s = paste_cars(s, cuts, rng, None)
    sh = P.Shown(
        s.image, s.boxes.astype(float).reshape(-1, 4), s.ignored.astype(float).reshape(-1, 4)
    )
    n = len(sh.boxes)
    if rng.random() < 0.35:
        sh = slabs(sh, None, read(textures[int(rng.integers(len(textures)))]), rng)
    if rng.random() < 0.25:
        sh = with_stones(sh, read(textures[int(rng.integers(len(textures)))]), rng)
    if rng.random() < src.pasted:
        sh = P.pasted(sh, scenes[int(rng.integers(len(scenes)))], rng)
    labels = np.append(s.labels[:n], np.zeros(len(sh.boxes) - n, np.int64))
    return (
        P.finished(sh.image, rng),
        sh.boxes.astype(np.float32),
        labels,
        sh.ignored.astype(np.float32),
        s.known,
    )


def slabs(sh, cars, texture, rng):
    """rectangles of real texture as long as cars: roofs, tables, containers, pools; nothing to be reported"""
    im = sh.image.astype(np.float32)
    own = np.zeros(im.shape[:2], np.int32)
    light = np.stack([np.ones(3), np.zeros(3)])
    for _ in range(int(rng.integers(1, 6))):
        L = float(np.exp(rng.uniform(np.log(24), np.log(300))))
        W = L / rng.uniform(1.0, 3.2)
        th, tw = texture.shape[:2]
        y, x = int(rng.integers(max(1, th - 40))), int(rng.integers(max(1, tw - 40)))
        g = int(rng.integers(16, 200))
        part = texture[y : y + g, x : x + int(g * rng.uniform(1, 2.5))].astype(np.float32)
        if min(part.shape[:2]) < 8:
            continue
        if rng.random() < 0.5:
            part = np.broadcast_to(part.mean((0, 1)), part.shape) + rng.normal(
                0, rng.uniform(0, 6), part.shape
            )
        if rng.random() < 0.4:
            part = part[..., rng.permutation(3)]
        part = part * rng.uniform(0.5, 1.6) + rng.uniform(-20, 40)
        part = cv2.resize(
            np.clip(part, 0, 255).astype(np.float32), (max(4, int(L)), max(4, int(W)))
        )
        for _ in range(int(rng.integers(0, 4))):
            a, b = sorted(rng.uniform(0, 1, 2))
            c = rng.uniform(0, 255, 3)
            if rng.random() < 0.5:
                part[:, int(a * L) : int(a * L) + max(1, int(0.06 * L))] = c
            else:
                part[int(a * W) : int(b * W), int(0.1 * L) : int(0.9 * L)] = (
                    part[int(a * W) : int(b * W), int(0.1 * L) : int(0.9 * L)] * 0.5 + c * 0.5
                )
        al = np.full(part.shape[:2], 255, np.float32)
        if rng.random() < 0.25:
            al[:] = 0
            cv2.ellipse(al, (int(L / 2), int(W / 2)), (int(L / 2), int(W / 2)), 0, 0, 360, 255, -1)
        ang = rng.uniform(0, 360)
        D = int(np.hypot(L, W)) + 16
        M = cv2.getRotationMatrix2D((L / 2, W / 2), ang, 1)
        M[:, 2] += D / 2 - np.array([L, W]) / 2
        t4 = cv2.warpAffine(np.dstack([part * al[..., None] / 255, al]), M, (D, D))
        d = rng.uniform(0, 0.12) * L
        th2 = rng.uniform(0, 6.28)
        shd = cv2.warpAffine(
            t4[..., 3], np.float32([[1, 0, d * np.cos(th2)], [0, 1, d * np.sin(th2)]]), (D, D)
        )
        shd = np.clip(shd - t4[..., 3], 0, 255) * float(rng.uniform(0.3, 1))
        cut = P.softened(np.dstack([t4, shd]).astype(np.float32), max(0, rng.normal(0.3, 0.5)))
        corner = np.round(rng.uniform(0, 1, 2) * SIDE - D / 2).astype(int)
        bx = sh.boxes
        if (
            (bx[:, 0] < corner[0] + cut.shape[1])
            & (bx[:, 2] > corner[0])
            & (bx[:, 1] < corner[1] + cut.shape[0])
            & (bx[:, 3] > corner[1])
        ).any():
            continue
        P.laid(im, own, cut, corner, 1, light, rng.uniform(0.2, 0.8))
    return P.Shown(np.clip(im, 0, 255).astype(np.uint8), sh.boxes, sh.ignored)


def hard(mined, read, rng):
    """a crop around what an earlier student reported on bare ground"""
    path = list(mined)[int(rng.integers(len(mined)))]
    rows = mined[path]
    w = np.array([r[3] for r in rows])
    r = rows[int(rng.choice(len(rows), p=w / w.sum()))]
    im = read(path)
    want = (
        float(np.exp(rng.uniform(np.log(24), np.log(220))))
        if r[4] == 1
        else float(np.exp(rng.uniform(np.log(14), np.log(120))))
    )
    f = float(np.clip(want / max(r[2], 4), 0.25, 3))
    ang = rng.uniform(0, 360)
    c = np.array(r[:2]) + rng.uniform(-0.35, 0.35, 2) * SIDE / f
    src, g = im, 1.0
    if f < 0.7:
        g = f * 1.2
        src = cv2.resize(im, None, fx=g, fy=g, interpolation=cv2.INTER_AREA)
    M = cv2.getRotationMatrix2D(tuple(c * g), ang, f / g)
    M[:, 2] += SIDE / 2 - c * g
    return cv2.warpAffine(src, M, (SIDE, SIDE), borderValue=(114,) * 3)


def main():
    first, count = int(sys.argv[1]), int(sys.argv[2])
    from functools import cache

    read = cache(lambda path: np.ascontiguousarray(cv2.imread(path)[..., ::-1]))
    import json

    table = json.load(open(STUDENT + "/teacher.json"))
    sim = replace(in_order(read_dataset(Path(STUDENT + "/simulated"))), name="simulated")
    srcs = plan(sim, table)
    scenes = read_scenes(Path(STUDENT + "/scenes"))
    cuts = car_cuts()
    print(
        len(scenes),
        "scenes",
        len(cuts),
        "cars",
        [(s.share.labelled.name, len(s.share.labelled)) for s in srcs],
        flush=True,
    )
    w = np.array([s.share.weight for s in srcs])
    w /= w.sum()
    mined = (
        json.load(open(STUDENT + "/mined.json")) if os.path.exists(STUDENT + "/mined.json") else {}
    )
    print("mined", sum(map(len, mined.values())), flush=True)
    tex = [p.path for s in srcs for p in s.share.labelled.pictures]
    os.makedirs(STUDENT + "/pool2", exist_ok=True)
    for shard in range(first, first + count):
        out = []
        t = time.process_time()
        for k in range(100):
            rng = np.random.default_rng((8, shard * 100 + k))
            src = srcs[int(rng.choice(len(srcs), p=w))]
            if mined and rng.random() < 0.14:
                im = P.finished(hard(mined, read, rng), rng)
                b, l, ig, kn = (
                    np.zeros((0, 4), np.float32),
                    np.zeros(0, np.int64),
                    np.zeros((0, 4), np.float32),
                    np.array([True, True, False]),
                )
            else:
                im, b, l, ig, kn = sample(src, scenes, cuts, read, rng, tex)
            ok, j = cv2.imencode(".jpg", im[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 96])
            out.append((j.tobytes(), b, l, ig, kn, src.share.labelled.name))
        pickle.dump(out, open(STUDENT + f"/pool2/{shard:04d}.tmp", "wb"))
        os.replace(STUDENT + f"/pool2/{shard:04d}.tmp", STUDENT + f"/pool2/{shard:04d}.pkl")
        print(shard, round(time.process_time() - t, 1), flush=True)


main()
