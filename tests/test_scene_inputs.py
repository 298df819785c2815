from gshell_mi.scene_inputs import scene_inputs


def test_includes_values_and_parameters(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "maps").mkdir()
    for name in ("mesh.ply", "map.exr", "skyA.exr", "in/near.npz", "unused.exr", "maps/sky.exr"):
        (tmp_path / name).write_text("")
    (tmp_path / "scene.xml").write_text(f"""<scene version="3.0.0">
        <default name="where" value="{tmp_path}"/> <default name="kind" value="envmap"/>
        <default name="sky" value="sky"/> <string name="filename" value="$skyA.exr"/>
        <path value="maps"/> <include filename="in/sensors.xml"/> <string name="filename" value="sky.exr"/>
        <emitter type="$kind"> <string name="filename" value="$where/map.exr"/> </emitter>
        <string name="missing" value="none.exr"/> <string name="long" value="{"x" * 5000}"/>
        <string name="empty" value=""/>
    </scene>""")
    (tmp_path / "in" / "sensors.xml").write_text("""<scene version="3.0.0">
        <string name="filename" value="mesh.ply"/> <string name="filename" value="near.npz"/>
        <include filename="sensors.xml"/>
    </scene>""")
    found = scene_inputs(tmp_path / "scene.xml")
    assert {file.resolve() for file in found} == {
        tmp_path / name
        for name in (
            "scene.xml",
            "in/sensors.xml",
            "mesh.ply",
            "map.exr",
            "skyA.exr",
            "in/near.npz",
            "maps/sky.exr",
        )
    }


def test_what_is_no_xml_names_nothing(tmp_path):
    for text in ("", "<scene", "\0", "<a>" * 10_000):
        (tmp_path / "scene.xml").write_text(text)
        assert scene_inputs(tmp_path / "scene.xml") == {tmp_path / "scene.xml"}
    assert scene_inputs(tmp_path / "none.xml") == {tmp_path / "none.xml"}
