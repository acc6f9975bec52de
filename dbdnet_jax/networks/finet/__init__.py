"""FINet (Xu et al. 2022): global features in two branches, one for each half of the pose."""
