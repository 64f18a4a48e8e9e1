"""Image quality: SSIM, PSNR, LPIPS, and the training loss, on the CPU and in Triton."""
