"""Cameras that are not those of the images are found."""

from dataclasses import replace

from materials import checks, clean

from heatsplat.contracts import Camera


def test_poses_of_another_frame_are_found():
    cameras = list(clean().cameras)
    assert "poses" in checks(replace(clean(), cameras=cameras[5:] + cameras[:5]))


def test_a_lens_that_is_not_that_of_the_images_is_found():
    def longer(camera: Camera) -> Camera:
        K = camera.K.clone()
        K[0, 0] *= 1.25
        K[1, 1] *= 1.25
        return replace(camera, K=K)

    assert "poses" in checks(replace(clean(), cameras=[longer(camera) for camera in clean().cameras]))
