"""Tests of files of episodes."""
