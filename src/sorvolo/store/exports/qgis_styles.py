"""How QGIS draws Sorvolo's layers: styles in QML, which a GeoPackage carries in its table `layer_styles`."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from xml.etree.ElementTree import Element, SubElement, tostring

_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_VERSION = "3.22.0"  # the form of the symbols, which later ones read, too


@dataclass(frozen=True)
class LayerStyle:
    """A layer's symbols: of what shape, by which attribute's values, in which colours (#rrggbb); "" is every other
    value. `opacity` is that of filled ground and of its rim; `is_hollow`: rims alone, thin where they are faint."""

    shape: str  # "marker", "line" or "fill"
    attribute: str
    colours: Mapping[str, str]
    opacity: float = 1.0
    is_hollow: bool = False


LAYER_STYLES: Mapping[str, LayerStyle] = MappingProxyType(
    {
        "objects": LayerStyle(
            "marker",
            "class",
            {
                "person": "#ff4fa3",
                "car": "#22c3e6",
                "small object": "#ffd43b",
                "": "#e9ecef",
            },
        ),
        "changes": LayerStyle(
            "fill",
            "kind",
            {
                "appeared": "#12b886",
                "disappeared": "#f03e3e",
                "replaced": "#9c6bff",
                "area": "#228be6",
                "moving": "#fd9e14",
                "": "#868e96",
            },
            is_hollow=True,
        ),
        "coverage": LayerStyle(
            "fill", "status", {"compared": "#12b886", "": "#868e96"}, opacity=0.2
        ),
        "frames": LayerStyle(
            "fill",
            "status",
            {
                "vision": "#35b98a",
                "gps-only": "#f0a835",
                "": "#adb5bd",
            },
            opacity=0.3,
            is_hollow=True,
        ),  # hundreds lie over each other, and the map is to be seen through them
        "track": LayerStyle("line", "", {"": "#343a40"}),
    }
)
"""The style of each layer, by its name; the colours are those of the station's page."""


def qml_of(style: LayerStyle) -> str:
    """The style as a QML document (QGIS 3)."""
    root = Element("qgis", {"version": _VERSION, "styleCategories": "Symbology"})
    values = list(style.colours.items())
    kind = "categorizedSymbol" if style.attribute else "singleSymbol"
    renderer = SubElement(
        root, "renderer-v2", {"type": kind, "symbollevels": "0", "enableorderby": "0"}
    )
    if style.attribute:
        renderer.set("attr", style.attribute)
        categories = SubElement(renderer, "categories")
        for number, (value, _) in enumerate(values):
            SubElement(
                categories,
                "category",
                {
                    "render": "true",
                    "symbol": str(number),
                    "value": value,
                    "label": value or "other",
                    "type": "string",
                },
            )
    symbols = SubElement(renderer, "symbols")
    for number, (_, colour) in enumerate(values):
        _symbol(symbols, str(number), style, colour)
    return _HEAD + tostring(root, encoding="unicode")


def _symbol(symbols: Element, name: str, style: LayerStyle, colour: str) -> None:
    symbol = SubElement(
        symbols, "symbol", {"type": style.shape, "name": name, "alpha": "1", "clip_to_extent": "1"}
    )
    opacity = round(255 * style.opacity)
    if style.shape == "marker":
        kind, options = (
            "SimpleMarker",
            {
                "name": "circle",
                "color": _rgba(colour),
                "outline_color": "16,32,27,255",
                "size": "3.2",
                "size_unit": "MM",
            },
        )
    elif style.shape == "line":
        kind, options = (
            "SimpleLine",
            {"line_color": _rgba(colour), "line_width": "0.5", "line_width_unit": "MM"},
        )
    else:
        kind, options = (
            "SimpleFill",
            {
                "color": _rgba(colour, opacity),
                "style": "no" if style.is_hollow else "solid",
                "outline_color": _rgba(colour, opacity),
                "outline_width": "0.5" if style.is_hollow and style.opacity == 1 else "0.1",
                "outline_width_unit": "MM",
            },
        )
    layer = SubElement(symbol, "layer", {"class": kind, "enabled": "1", "pass": "0", "locked": "0"})
    listed = SubElement(layer, "Option", {"type": "Map"})
    for key, value in options.items():
        SubElement(listed, "Option", {"type": "QString", "name": key, "value": value})


def _rgba(colour: str, opacity: int = 255) -> str:
    red, green, blue = (int(colour[at : at + 2], 16) for at in (1, 3, 5))
    return f"{red},{green},{blue},{opacity}"
