"""Bytes of a valid file, damaged at random: what readers are fuzzed with."""

from hypothesis import strategies as st


def mutated(data: st.DataObject, valid: bytes, most: int = 12) -> bytes:
    """The bytes with some changed, cut out or doubled."""
    changed = bytearray(valid)
    for _ in range(data.draw(st.integers(1, most))):
        if not changed:
            break
        place = data.draw(st.integers(0, len(changed) - 1))
        action = data.draw(st.integers(0, 2))
        if action == 0:
            changed[place] = data.draw(st.integers(0, 255))
        elif action == 1:
            del changed[place : place + data.draw(st.integers(1, 40))]
        else:
            changed[place:place] = changed[place : place + data.draw(st.integers(1, 40))]
    return bytes(changed)
