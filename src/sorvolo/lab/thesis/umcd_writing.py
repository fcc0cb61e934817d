"""A video's metadata file as the UMCD dataset has one, of a simulated flight whose truth is known."""

from collections.abc import Iterable, Mapping, Sequence
from math import ceil, floor

from sorvolo.lab.datasets.checking import DEFAULT_CLASSES, plain
from sorvolo.lab.datasets.umcd import ROUNDED_S, UmcdMetadata
from sorvolo.paths import JsonView


def umcd_metadata(fps: float, objects: Iterable[JsonView], boxes: JsonView, flight: int) -> str:
    """The text: each object that came with a later flight, when it is in view, and its boxes (ours, `Box:` lines).

    `objects` are the features of a simulation's objects.geojson, `boxes` the COCO content of the flight's boxes.json,
    `flight` its number. Objects that no picture shows are left out. Sizes are in centimetres, times in whole seconds.
    """
    came = {
        each["properties"]["id"]: each["properties"]
        for each in objects
        if flight in each["properties"]["flights"] and 1 not in each["properties"]["flights"]
    }
    seen: dict[int, list[tuple[int, list[float]]]] = {}
    for row in boxes["annotations"]:
        if row["object_id"] in came:
            seen.setdefault(row["object_id"], []).append((row["image_id"], row["bbox"]))
    lines = [f"Fps: {fps:g}", ""]
    for number, (thing, views) in enumerate(seen.items(), start=1):
        lines += [*_block(number, came[thing], views, fps), ""]
    return "\n".join(lines)


def placed_metadata(
    stated: UmcdMetadata, fps: float, boxes: Mapping[str, Sequence[Sequence[int]]]
) -> str:
    """The text with the objects' places where a comparison of both flights shows them: `boxes` by the frame's name.

    The first flight has no objects, so a frame's only box is the object that is surely the only one in view.
    """
    lines = [f"Fps: {fps:g}"]
    for number, (name, (start, end)) in enumerate(zip(stated.names, stated.in_view_s)):
        lines += [f"Object {number + 1}", f"Type: {name}", f"Appearance: {start:g} to {end:g}"]
        for frame, found in boxes.items():
            time_s = int(frame) / fps
            others = stated.in_view_s[:number] + stated.in_view_s[number + 1 :]
            is_alone = all(not a - ROUNDED_S <= time_s <= b + ROUNDED_S for a, b in others)
            if len(found) == 1 and is_alone and start + ROUNDED_S <= time_s <= end - ROUNDED_S:
                lines.append(f"Box: {frame} {' '.join(map(str, found[0]))}")
    return "\n".join(lines)


def _block(
    number: int, properties: JsonView, views: list[tuple[int, list[float]]], fps: float
) -> list[str]:
    name = (
        properties["subtype"]
        if plain(properties["subtype"]) in DEFAULT_CLASSES
        else properties["class"]
    )
    sizes_cm = (round(100 * properties[f"{side}_m"]) for side in ("length", "width", "height"))
    frames = [frame for frame, _ in views]
    is_square = properties["length_m"] == properties["width_m"]
    shape = "square" if is_square else "rectangular"
    return [
        f"Object {number}",
        f"Type: {name}",
        f"Shape: {'person' if properties['class'] == 'person' else shape}",
        f"Dimension: {' x '.join(map(str, sizes_cm))}",
        "Color: not stated",
        f"Movement: {'moving' if properties['moving'] else 'static'}",
        f"Appearance: {floor(min(frames) / fps):02d} to {ceil(max(frames) / fps):02d}",
        *(f"Box: {frame} {' '.join(f'{edge:g}' for edge in box)}" for frame, box in views),
    ]
