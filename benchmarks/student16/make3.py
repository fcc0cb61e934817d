import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""make3.py POOL FIRST COUNT SEED [STEP]: shards of day samples with rendered clutter and mined crops"""
import sys, os

argv = sys.argv
src = open(STUDENT + "/make.py").read().rsplit("\nmain()", 1)[0]
exec(compile(src, "make.py", "exec"))
import json
from functools import cache

MINED = json.load(open(argv[5] if len(argv) > 5 else STUDENT + "/mined0.json"))
MAXBOX = 40


def plan3(sim):
    site = P.ground(DATA, "caliterra", "IMG_9354.jpg", "IMG_9389.jpg")
    fw = P.ground(DATA, "fixed_wing")
    fw = fw.only(fw.pictures[10:])
    cars = aerial_cars(DATA)["train"]
    cars = cars.only(
        [
            replace(
                p,
                ignored_px=np.vstack(
                    [
                        p.ignored_px.reshape(-1, 4),
                        np.array(MINED["people"].get(p.path, []), np.float32).reshape(-1, 4),
                    ]
                ),
            )
            for p in cars.pictures
        ]
    )
    cars = replace(cars, unlabelled=frozenset({SMALL}))
    th = hituav(DATA)["train"]
    th = th.only([p for p in th.pictures if len(p.labels)])
    painted = replace(site, name="painted")
    return [
        Src(Share(site, 1.6, (0.3, 2.6), pastes=SMALL), 0.65, cars=0.3),
        Src(Share(fw, 1.4, (0.4, 3.0), pastes=SMALL), 0.55, cars=0.35),
        Src(Share(cars, 2.8, (0.3, 3.2)), 0.5, cars=0.1),
        Src(Share(sim, 1.8, (0.6, 3.0)), 0.35),
        Src(Share(tinyperson(DATA)["train"], 2.0, (1.0, 3.0), aslant=True, pastes=SMALL), 0.25),
        Src(Share(mannequin(DATA)["train"], 0.6, (0.35, 1.2), pastes=SMALL), 0.5, cars=0.3),
        Src(Share(th, 1.0, (1.2, 3.0)), 0.2, P.by_day, 14.0),
        Src(Share(painted, 2.0, (0.5, 2.0)), 0.6, P.Painted(30), cars=0.4),
    ]


def clutter(sh, scene, rng):
    side = SIDE
    im = sh.image.astype(np.float32)
    own = np.zeros((side, side), np.int32)
    light = P.drawn_tone(sh.image, rng)
    ppm = float(np.exp(rng.uniform(np.log(10), np.log(scene.px_per_m))))
    turns, mirror = int(rng.integers(4)) * scene.is_steep, bool(rng.random() < 0.5)
    soft = max(0.0, rng.normal(0.3, 0.45))
    n = int(rng.choice([1, 2, 3, 5, 8, 12], p=[0.15, 0.2, 0.25, 0.2, 0.12, 0.08]))
    group = rng.random() < 0.35
    mid = rng.uniform(0.2, 0.8, 2) * side
    same = rng.random() < 0.25
    idx = rng.permutation(len(scene.sprites))[:n]
    if same:
        idx = [int(idx[0])] * n
    for k, i in enumerate(idx):
        sp = scene.sprites[i]
        f = ppm / scene.px_per_m * rng.uniform(0.93, 1.07)
        big = max(sp.rgba.shape[:2]) * f
        if big > 330:
            f *= 330 / big * rng.uniform(0.5, 1)
        cut = P.softened(P.resized(sp, f, turns, mirror), soft)
        c = mid + rng.normal(0, 2.2, 2) * ppm if group else rng.uniform(-0.02, 1.02, 2) * side
        corner = np.round(c - np.array(cut.shape[1::-1]) / 2).astype(int)
        if not P._is_free(sh.boxes, corner, cut.shape):
            continue
        P.laid(im, own, cut, corner, 1, light, scene.sunlight)
    return P.Shown(np.clip(im, 0, 255).astype(np.uint8), sh.boxes, sh.ignored)


def sample3(src, scenes, clut, cuts, read, rng, textures):
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
    bare = rng.random() < 0.3  # nothing is pasted but clutter
    if not bare and src.cars and rng.random() < src.cars:
        s = paste_cars(s, cuts, rng, None)
    sh = P.Shown(
        s.image, s.boxes.astype(float).reshape(-1, 4), s.ignored.astype(float).reshape(-1, 4)
    )
    n = len(sh.boxes)
    if rng.random() < 0.12:
        sh = slabs(sh, None, read(textures[int(rng.integers(len(textures)))]), rng)
    if rng.random() < 0.2:
        sh = with_stones(sh, read(textures[int(rng.integers(len(textures)))]), rng)
    if rng.random() < (0.75 if bare else 0.42):
        sh = clutter(sh, clut[int(rng.integers(len(clut)))], rng)
    if not bare and rng.random() < src.pasted:
        sh = P.pasted(sh, scenes[int(rng.integers(len(scenes)))], rng)
    labels = np.append(s.labels[:n], np.zeros(len(sh.boxes) - n, np.int64))
    return (
        P.finished(sh.image, rng),
        sh.boxes.astype(np.float32),
        labels,
        sh.ignored.astype(np.float32),
        s.known,
    )


def hard_labelled(rows_by, table, read, rng):
    """a crop around a false report in a labelled picture, turned by quarters, with its labels"""
    from sorvolo.lab.training.samples import boxes_in_crop, _warped

    path = list(rows_by)[int(rng.integers(len(rows_by)))]
    rows = rows_by[path]
    w = np.array([r[3] for r in rows])
    r = rows[int(rng.choice(len(rows), p=w / w.sum()))]
    p, known = table[path]
    im = read(path)
    want = (
        float(np.exp(rng.uniform(np.log(24), np.log(220))))
        if r[4] == 1
        else float(np.exp(rng.uniform(np.log(14), np.log(120))))
    )
    f = float(np.clip(want / max(r[2], 4), 0.25, 3))
    c = np.array(r[:2]) + rng.uniform(-0.35, 0.35, 2) * SIDE / f
    a = rng.integers(4) * np.pi / 2
    m = 1.0 if rng.random() < 0.5 else -1.0
    co, si = f * np.cos(a), f * np.sin(a)
    T = np.array([[co * m, -si], [si * m, co]])
    M = np.eye(3)
    M[:2, :2] = T
    M[:2, 2] = SIDE / 2 - T @ c
    out, M = _warped(im, M, SIDE)
    b, seen = boxes_in_crop(np.asarray(p.boxes_px, float), M, SIDE)
    ig, vis = boxes_in_crop(np.asarray(p.ignored_px, float), M, SIDE)
    keep = (seen >= 0.4) & ((b[:, 2:] - b[:, :2]).max(1, initial=0) >= 3)
    ig = np.vstack([ig[vis > 0], b[~keep & (seen > 0.02)]])
    return out, b[keep].astype(np.float32), p.labels[keep], ig.astype(np.float32), known


def main3():
    pool, first, count, seed = argv[1], int(argv[2]), int(argv[3]), int(argv[4])
    read = cache(lambda path: np.ascontiguousarray(cv2.imread(path)[..., ::-1]))
    sim = (
        replace(in_order(read_dataset(Path(STUDENT + "/simulated"))), name="simulated")
        if os.environ.get("SIM", "1") == "1"
        else None
    )
    srcs = plan3(sim) if sim else plan3(P.ground(DATA, "caliterra", "IMG_9354.jpg", "IMG_9389.jpg"))
    scenes = read_scenes(Path(STUDENT + "/scenes"))
    clut = read_scenes(Path(STUDENT + "/clutter"))
    cuts = car_cuts()
    print(
        len(scenes),
        len(clut),
        len(cuts),
        [(s.share.labelled.name, len(s.share.labelled)) for s in srcs],
        flush=True,
    )
    w = np.array([s.share.weight for s in srcs])
    w /= w.sum()
    tex = [p.path for s in srcs for p in s.share.labelled.pictures]
    table = {
        p.path: (p, np.array([True, True, False])) for s in srcs for p in s.share.labelled.pictures
    }
    G, L = MINED["ground"], {k: v for k, v in MINED["labelled"].items() if k in table}
    os.makedirs(STUDENT + "/" + pool, exist_ok=True)
    for shard in range(first, first + count):
        out = []
        t = time.process_time()
        t1 = time.time()
        for k in range(100):
            rng = np.random.default_rng((seed, shard * 100 + k))
            src = srcs[int(rng.choice(len(srcs), p=w))]
            u = rng.random()
            name = src.share.labelled.name
            if u < 0.10 and G:
                im = hard(G, read, rng)
                sh = P.Shown(im, np.zeros((0, 4)), np.zeros((0, 4)))
                if rng.random() < 0.25:
                    sh = P.pasted(sh, scenes[int(rng.integers(len(scenes)))], rng)
                im, b, l, ig, kn = (
                    P.finished(sh.image, rng),
                    sh.boxes.astype(np.float32),
                    np.zeros(len(sh.boxes), np.int64),
                    sh.ignored.astype(np.float32),
                    np.array([True, True, False]),
                )
                name = "mined"
            elif u < 0.16 and L:
                im, b, l, ig, kn = hard_labelled(L, table, read, rng)
                im = P.finished(im, rng)
                name = "mined-labelled"
            else:
                im, b, l, ig, kn = sample3(src, scenes, clut, cuts, read, rng, tex)
            ok, j = cv2.imencode(".jpg", im[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 96])
            out.append((j.tobytes(), b, l, ig, kn, name))
        f = STUDENT + f"/{pool}/{shard:04d}"
        pickle.dump(out, open(f + ".tmp", "wb"))
        os.replace(f + ".tmp", f + ".pkl")
        print(shard, round(time.process_time() - t, 1), round(time.time() - t1, 1), flush=True)


main3()
