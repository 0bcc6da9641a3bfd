"""Hashes of the frozen behaviour of each work cell, which every result records.

A hash is of compiled models, observations, and outcomes of throws by the first policy for the work cell, as
`tests/frozen` has them. Source text is no part of it. Written by `python tests/test_frozen.py`.
"""

HASHES: dict[str, str] = {
    "fr3_allegro": "d6bb0bc79d0f",
    "two_ur5e_allegro": "c3162662b229",
    "ur5e_allegro": "aad10338c068",
    "ur5e_allegro_release": "b32abda2e94e",
    "ur5e_allegro_right": "8bb06fbc25a5",
    "ur5e_leap": "39054ca722f5",
}
