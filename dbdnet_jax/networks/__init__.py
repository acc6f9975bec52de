"""The learned methods: layers that they share, their parameters and files of weights."""
