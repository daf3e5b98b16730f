"""Makes tiny synthetic AMASS, SAMP and canonical files, and what an independent NumPy/SciPy reader finds in them.

    python arrays.py ../../fixtures/importers

No motion capture goes in: all numbers are random. Frames at 40 per second are chained and interpolated by SciPy's rotations.
"""

import json
import pickle
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]


def random_poses(rng, frames, width):
    """Bodies that stand along z, turn and bend a little."""
    poses = rng.normal(0, 0.3, (frames, width))
    stand = Rotation.from_euler("x", 90, degrees=True)
    for t in range(frames):
        poses[t, :3] = (Rotation.from_euler("z", 20 * t, degrees=True) * stand * Rotation.from_rotvec(poses[t, :3])).as_rotvec()
    return poses


def found(poses, trans, fps, frame=None):
    """Root and world rotations (x y z w) of each frame at 40 per second."""
    world = []
    for j, parent in enumerate(PARENTS):
        local = Rotation.from_rotvec(poses[:, 3 * j : 3 * j + 3])
        world.append(local if parent < 0 else world[parent] * local)
    if frame is not None:
        world = [Rotation.from_matrix(frame[0]) * r for r in world]
        trans = trans @ frame[0].T + frame[1]
    times = np.arange(len(poses)) / fps
    at = np.arange(int(np.floor(times[-1] * 40 + 1e-6)) + 1) / 40
    roots = np.stack([np.interp(at, times, trans[:, i]) for i in range(3)], axis=1)
    rots = np.stack([Slerp(times, r)(at).as_quat() for r in world], axis=1)
    return [[np.round(p, 6).tolist(), np.round(q, 7).tolist()] for p, q in zip(roots, rots)]


def amass(rng, out, results):
    poses, trans = random_poses(rng, 8, 165), rng.normal(0, 1, (8, 3))
    extra = np.array([{"any": "thing"}], dtype=object)
    np.savez(out / "smplx.npz", poses=poses, trans=trans, betas=rng.normal(0, 1, 16), gender="female", mocap_frame_rate=120.0,
             surface_model_type="smplx", labels=extra)  # fmt: skip
    results["smplx.npz"] = found(poses, trans, 120)
    poses, trans = random_poses(rng, 7, 156).astype(np.float32), rng.normal(0, 1, (7, 3)).astype(">f4")
    np.savez_compressed(out / "smplh.npz", poses=np.asfortranarray(poses), trans=trans, gender=b"male", mocap_framerate=np.array([60]))
    results["smplh.npz"] = found(poses.astype(float), trans.astype(float), 60)


def samp(rng, out, results):
    poses, trans = random_poses(rng, 5, 165).astype(np.float32), rng.normal(0, 1, (5, 3)).astype(np.float32)
    data = {"pose_est_fullposes": poses, "pose_est_trans": trans, "shape_est_betas": rng.normal(0, 1, 10), "mocap_framerate": 120}
    data |= {"notes": ["a", None, True, -3, 2**40, {"nested": (1.5, b"bytes")}]}
    for protocol in (2, 4, 5):
        name = f"samp{protocol}.pkl"
        data["mocap_framerate"] = {2: 120, 4: np.float64(120), 5: 120.0}[protocol]
        data["pose_est_fullposes"] = np.asfortranarray(poses) if protocol == 5 else poses
        content = pickle.dumps(data, protocol=protocol)
        # The name that NumPy before 2.0 wrote.
        content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray") if protocol == 2 else content
        (out / name).write_bytes(content)
        results[name] = found(poses.astype(float), trans.astype(float), 120)
    python2 = b"\x80\x02}(" + b"".join(python2_item(k, data[k]) for k in ("pose_est_fullposes", "pose_est_trans")) + b"U\x0fmocap_framerateKxu."
    (out / "samp_python2.pkl").write_bytes(python2)
    results["samp_python2.pkl"] = results["samp2.pkl"]
    assert np.array_equal(pickle.loads(python2, encoding="latin1")["pose_est_trans"], trans)


def python2_item(key, array):
    """A key and an array as Python 2 pickled them: strings of bytes."""
    key, raw = key.encode(), array.tobytes("C")
    text = b"U" + bytes([len(key)]) + key + b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    shape = b"".join(b"M" + d.to_bytes(2, "little") for d in array.shape) + b"\x86"
    dtype = b"cnumpy\ndtype\nU\x02f4K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    return text + b"(K\x01" + shape + dtype + b"\x89T" + len(raw).to_bytes(4, "little") + raw + b"tb"


def canonical(rng, out, results):
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    data = {
        "transf_rotmat": turn, "transf_transl": rng.normal(0, 1, (1, 3)), "trans": rng.normal(0, 1, (20, 3)),
        "poses": random_poses(rng, 20, 165), "betas": rng.normal(0, 1, 10), "gender": "neutral", "mocap_framerate": 120.0,
        "joints": rng.normal(0, 1, (20, 22, 3)), "marker_ssm2_67": rng.normal(0, 1, (20, 67, 3)),
    }  # fmt: skip
    data = {k: v.astype(np.float32) if isinstance(v, np.ndarray) else v for k, v in data.items()}
    np.savez(out / "canonical.npz", **data)
    frame = (data["transf_rotmat"].astype(float), data["transf_transl"].astype(float))
    results["canonical.npz"] = found(data["poses"].astype(float), data["joints"][:, 0].astype(float), 40, frame)


def main():
    out = Path(sys.argv[1])
    rng, results = np.random.default_rng(23), {}
    amass(rng, out, results)
    samp(rng, out, results)
    canonical(rng, out, results)
    (out / "poses.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main()
