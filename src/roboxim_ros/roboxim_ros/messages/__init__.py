"""Messages and the core's values: conversion, serialising, definitions."""
