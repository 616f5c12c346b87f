"""Metrics: pure functions that compare two images [H, W, C] in [0, 1] and need no gradient."""

from heatsplat.metrics.lpips import Lpips as Lpips
from heatsplat.metrics.lpips import LpipsUnavailable as LpipsUnavailable
from heatsplat.metrics.lpips import load_lpips as load_lpips
from heatsplat.metrics.mae import mae_c as mae_c
from heatsplat.metrics.mae_roi import mae_roi_image_c as mae_roi_image_c
from heatsplat.metrics.mae_roi import mae_roi_scene_c as mae_roi_scene_c
from heatsplat.metrics.mae_roi import scene_threshold as scene_threshold
from heatsplat.metrics.otsu import otsu_level as otsu_level
from heatsplat.metrics.psnr import psnr as psnr
from heatsplat.metrics.scores import DEFINITIONS as DEFINITIONS
from heatsplat.metrics.scores import IMAGE_SCORES as IMAGE_SCORES
from heatsplat.metrics.scores import Scorer as Scorer
from heatsplat.metrics.scores import mean_of_images as mean_of_images
from heatsplat.metrics.ssim import ssim as ssim
