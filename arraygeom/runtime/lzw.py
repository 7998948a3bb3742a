"""Length of a TIFF strip in LZW: libtiff reports damage only to a terminal, if at all."""

from __future__ import annotations

import numpy as np

from .compiled import compiled

CLEAR, END = 256, 257


@compiled(nogil=True, cache=True)
def lzw_length(data):
    """Count the bytes that LZW codes of a TIFF strip stand for, up to their end code or the end of the data.

    Args:
        data: codes (n), uint8, the most significant bit first.

    Returns:
        The length; 0 if a code is not in the table or follows a full one, and for no data.
    """
    lengths = np.ones(4096, np.int64)
    width, known, before, total, position = 9, END + 1, -1, 0, 0
    while position + width <= 8 * len(data):
        byte, bits = position >> 3, 0
        for k in range(3):
            bits = (bits << 8) | (data[byte + k] if byte + k < len(data) else 0)
        code = (bits >> (24 - width - (position & 7))) & ((1 << width) - 1)
        position += width
        if code == END:
            return total
        if code == CLEAR:
            width, known, before = 9, END + 1, -1
            continue
        if before >= 0:
            if known == 4096:
                return 0
            lengths[known] = lengths[before] + 1
            known += 1
        if code >= known:
            return 0
        total += lengths[code]
        before = code
        if known >= (1 << width) - 1 and width < 12:
            width += 1
    return total
