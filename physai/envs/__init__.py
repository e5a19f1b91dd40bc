"""Environments: one simulation core, a TorchRL shell and Gymnasium shells."""
