"""OMNet (Xu et al. 2021): masks and a pose, estimated in turns from global features."""
