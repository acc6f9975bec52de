"""RIENet (Shen et al. 2022): unsupervised registration with a confidence for every point."""
