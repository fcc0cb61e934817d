"""Units of other systems, of the Earth and of clocks in ours: metres, metres a second, nanoseconds."""

FOOT_M = 0.3048
"""The international foot."""

SURVEY_FOOT_M = 1200 / 3937
"""The US survey foot, which maps of some states still count in."""

M_PER_DEG_LATITUDE = 111_320.0
"""A degree of latitude on the ground, right to 0.6 %: enough for search distances and for the rounding of a fix."""

KNOT_M_S = 1852 / 3600
MILE_AN_HOUR_M_S = 0.44704  # exactly: 1609.344 m in an hour
KM_AN_HOUR_M_S = 1 / 3.6

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
