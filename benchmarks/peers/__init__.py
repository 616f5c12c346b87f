"""heatsplat beside another program that trains Gaussians on a CPU: rasteriser by rasteriser, and to equal PSNR."""
