"""Videos of datasets, encoded and decoded by worker processes.

PyAV's wheel bundles FFmpeg with GPL codecs (x264, x265). Only `roboxim_datasets.video.worker` imports it, in a separate
process that receives raw frames and file names over a pipe. The rest of RoboXim talks to it through
`roboxim_datasets.video.client`.
"""
