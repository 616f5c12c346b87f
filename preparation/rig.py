"""A thermal camera beside a visible one: how both are brought to one world, and the model of the thermal one alone."""

from __future__ import annotations

import numpy as np
import torch

from heatsplat.datamodules.formats.colmap import pose_matrix
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.geometry.alignment import Similarity, pose_errors


def settle_rig(model: pycolmap.Reconstruction, name_of: dict[str, str]) -> Similarity | None:
    """The similarity that brings the thermal cameras to the visible ones beside them; None where fewer than three stand beside
    one.

    ``model`` is changed: a bundle adjustment of all images (Triggs et al. 2000) in which the thermal camera's place in the rig
    is free, as one pose for all frames, finds how it is turned. No feature is common to both cameras, so nothing but their
    poses ties the two worlds: about an orbit that looks at its middle the thermal one may have any size. So its size and
    place are those at which the centres of both fit best (Umeyama 1991).

    **Convention:** poses are world to camera in OpenCV axes, lengths are in units of the world (metres with GPS); the
    similarity goes from the thermal world to the visible one.

    Args:
        model: of both cameras; images of thermal frames are called thermal/..., their photos rgb/... with the same rest.
        name_of: by name of a thermal image in the model, that of its frame.
    """
    adjusted = pycolmap.BundleAdjustmentConfig()
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    for image in placed.values():
        adjusted.add_image(image.image_id)
    adjusted.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(refine_sensor_from_rig=True, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.create_default_bundle_adjuster(options, adjusted, model).solve()
    pairs = [
        (placed[name], placed.get(name.replace("thermal/", "rgb/", 1))) for name in sorted(placed) if name in name_of
    ]
    both = [(thermal, photo) for thermal, photo in pairs if photo is not None]
    if len(both) < 3:
        return None
    thermal, visible = (torch.from_numpy(np.stack([pose_matrix(pair[k]) for pair in both])) for k in (0, 1))
    return pose_errors(thermal, visible).similarity


def thermal_only(
    model: pycolmap.Reconstruction, name_of: dict[str, str], moved: Similarity | None = None
) -> pycolmap.Reconstruction:
    """The thermal images of a model under their own names, each a frame of its own, with the points of all cameras.

    ``moved`` is applied to the images and to the points that they see, not to those that photos alone see.
    """
    kept = [image for image in model.images.values() if image.has_pose and image.name in name_of]
    own = pycolmap.Reconstruction()
    for camera_id in sorted({image.camera_id for image in kept}):
        own.add_camera_with_trivial_rig(model.cameras[camera_id])
    for image in sorted(kept, key=lambda image: name_of[image.name]):
        fresh = pycolmap.Image(
            name=name_of[image.name],
            camera_id=image.camera_id,
            image_id=image.image_id,
            keypoints=np.array([p.xy for p in image.points2D]).reshape(-1, 2),
        )
        pose = image.cam_from_world()
        if moved is not None:
            turn = pose.rotation.matrix() @ moved.rotation.numpy().T
            pose = pycolmap.Rigid3d(
                pycolmap.Rotation3d(turn), float(moved.scale) * pose.translation - turn @ moved.shift.numpy()
            )
        own.add_image_with_trivial_frame(fresh, pose)
    seen = {image.image_id for image in kept}
    for key, point in sorted(model.points3D.items()):
        track = pycolmap.Track([e for e in point.track.elements if e.image_id in seen])
        own_place = moved is None or not track.elements
        xyz = point.xyz if own_place else moved(torch.from_numpy(point.xyz)[None])[0].numpy()
        own.add_point3D_with_id(key, pycolmap.Point3D(xyz=xyz, color=point.color, error=point.error, track=track))
    return own
