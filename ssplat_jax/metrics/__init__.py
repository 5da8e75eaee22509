"""Image quality metrics: PSNR, SSIM and LPIPS."""
