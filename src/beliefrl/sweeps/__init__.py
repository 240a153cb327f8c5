"""Sweeps of many trainings: what to train (`experiments`, `sources`), the list (`plan`), where they run (`places`), the
loop (`run`) and its display (`progress`); and searches for hyperparameters (`tune`, `study`, `ranges`).
"""
