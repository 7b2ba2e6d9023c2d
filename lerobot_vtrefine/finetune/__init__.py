"""DPPO fine-tuning of diffusion policies (``dppo.py``) and what surrounds it.

The algorithm knows only the protocols of ``protocols.py``; ``vtrefine-finetune`` connects it to LeRobot.
"""
