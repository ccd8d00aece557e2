"""Rows found by key, beside a dict."""

import numpy as np
from numba import njit

from gnss_sem_map.voxels.hash_table import HashTable, room_in, slot_of


@njit
def _count(rows, slots, count, start, keys):
    """Count in its row how often each key comes, from `start` on, until the table is full."""
    room, names, size = room_in(rows, slots), rows[:, 0], len(slots)
    for i in range(start, len(keys)):
        if count == room:
            return count, i
        slot = slot_of(keys[i], names, slots, size)
        if slots[slot] < 0:
            slots[slot], names[count] = count, keys[i]
            count += 1
        rows[slots[slot], 1] += 1
    return count, len(keys)


def test_a_table_keeps_every_row_while_it_grows_in_place_and_rows_are_in_the_order_of_their_keys():
    keys = np.random.default_rng(1).integers(-(1 << 62), 1 << 62, 3000).repeat(2)[::-1]
    keys = np.concatenate([keys, keys[::3], [0, -1, 0]])  # any key: none marks an empty row
    table, done, grown = HashTable(2, 16), 0, 0
    while done < len(keys):
        table.count, done = _count(table.rows, table.slots, table.count, done, keys)
        if done < len(keys):
            table.grow()
            grown += 1
    expected: dict[int, int] = {}
    for key in keys.tolist():
        expected[key] = expected.get(key, 0) + 1
    assert grown > 10
    assert table.filled.tolist() == [[key, times] for key, times in expected.items()]
    assert not table.rows[table.count :].any()  # new rows are empty
    assert table.nbytes <= 1.5 * table.count * (2 * 8 + 4 * 4)
