"""Recordings as users have them: bags, pose files and folders of pictures become captures."""
