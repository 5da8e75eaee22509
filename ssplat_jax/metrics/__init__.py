"""PSNR, SSIM and LPIPS."""
