"""Motion capture files that were cut, lengthened or overwritten anywhere: numbers that hold together, or one line."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from test_amc import MOTION, write
from test_amc import SMALL as SMALL_ASF
from test_bvh import SMALL as SMALL_BVH

from mocap import amc, bvh

ANY = [b"", b"\n", b"9", b" ", b"-", b"\xff"]


def damage(data, raw, pieces):
    """Up to three times: up to thirty bytes replaced by something else, in place."""
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(raw)))
        raw[at : at + data.draw(st.integers(0, 30))] = data.draw(st.sampled_from(ANY + pieces))


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_bvh(tmp_path_factory, data):
    """Either a Bvh whose parts agree, or one BvhError."""
    raw = bytearray(SMALL_BVH.encode())
    damage(data, raw, [b"{", b"}", b"JOINT a ", b"MOTION\n", b"End "])
    path = tmp_path_factory.mktemp("damaged") / "clip.bvh"
    path.write_bytes(bytes(raw))
    try:
        clip = bvh.read(path)
    except bvh.BvhError as e:
        assert len(str(e).splitlines()) == 1
    else:
        assert clip.values.shape[1] == sum(map(len, clip.channels)) and np.isfinite(clip.values).all()
        assert np.isfinite(bvh.global_pose(clip)[0]).all()


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_asf_and_amc(tmp_path_factory, data):
    """Damage in either file: a finite pose, or one AmcError."""
    both = [bytearray(SMALL_ASF.encode()), bytearray(MOTION.encode())]
    pieces = [b"begin\n", b"end\n", b"root ", b":root\n", b"(", b"leg toe\n", b"e9"]
    damage(data, data.draw(st.sampled_from(both)), pieces)
    asf, motion = write(tmp_path_factory.mktemp("damaged"), bytes(both[0]), bytes(both[1]))
    try:
        s = amc.read_asf(asf)
        pose = amc.global_pose(s, amc.read_amc(motion, s))
    except amc.AmcError as e:
        assert len(str(e).splitlines()) == 1
    else:
        assert np.isfinite(pose[0]).all() and np.isfinite(pose[1]).all()
