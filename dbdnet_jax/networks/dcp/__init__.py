"""DCP (Wang & Solomon 2019): soft correspondences of learned features, and one Procrustes solve."""
