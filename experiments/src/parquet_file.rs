//! `runs.parquet`: the same rows as `runs.csv`, cells and seeds as integers, other columns of numbers as doubles.

use crate::fail::Fail;
use parquet::{
    basic::{Compression, ConvertedType, Repetition, Type as Physical},
    data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type},
    errors::ParquetError,
    file::{properties::WriterProperties, writer::SerializedFileWriter},
    schema::types::Type,
};
use rowgram::io::output;
use std::{path::Path, sync::Arc};

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Integers,
    Doubles,
    Text,
}

/// Writes rows whose first is the header. Cells and seeds are whole numbers; any other column is of doubles where
/// every cell that is not empty is a number, otherwise of text; empty cells are null in the former.
pub(crate) fn write(path: &Path, rows: &[Vec<String>]) -> Result<(), Fail> {
    let bytes = encode(rows).map_err(|e| Fail::Failed(format!("{}: {e}", path.display())))?;
    output::write(path, true, |out| out.write_all(&bytes))?;
    Ok(())
}

fn encode(rows: &[Vec<String>]) -> Result<Vec<u8>, ParquetError> {
    let Some((header, rows)) = rows.split_first() else { return Ok(Vec::new()) };
    let kinds: Vec<Kind> = header
        .iter()
        .enumerate()
        .map(|(c, name)| {
            let all =
                |good: fn(&str) -> bool| rows.iter().all(|row| row[c].is_empty() || good(&row[c]));
            match name.as_str() {
                "reason" | "status" => Kind::Text,
                "cell" | "seed" if all(|cell| cell.parse::<i64>().is_ok()) => Kind::Integers,
                _ if all(|cell| cell.parse::<f64>().is_ok()) => Kind::Doubles,
                _ => Kind::Text,
            }
        })
        .collect();
    let fields = header
        .iter()
        .zip(&kinds)
        .map(|(name, kind)| {
            let field = match kind {
                Kind::Integers => Type::primitive_type_builder(name, Physical::INT64)
                    .with_repetition(Repetition::OPTIONAL),
                Kind::Doubles => Type::primitive_type_builder(name, Physical::DOUBLE)
                    .with_repetition(Repetition::OPTIONAL),
                Kind::Text => Type::primitive_type_builder(name, Physical::BYTE_ARRAY)
                    .with_converted_type(ConvertedType::UTF8)
                    .with_repetition(Repetition::REQUIRED),
            };
            field.build().map(Arc::new)
        })
        .collect::<Result<Vec<_>, _>>()?;
    let schema = Arc::new(Type::group_type_builder("runs").with_fields(fields).build()?);
    // The name of the writer is part of the file; without a version the bytes stay the same.
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_created_by("rowgram experiments".to_owned())
        .build();
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties))?;
    let mut group = writer.next_row_group()?;
    for (c, kind) in kinds.iter().enumerate() {
        let Some(mut column) = group.next_column()? else { break };
        let levels: Vec<i16> = rows.iter().map(|row| i16::from(!row[c].is_empty())).collect();
        match kind {
            Kind::Integers => {
                let values: Vec<i64> = rows.iter().filter_map(|row| row[c].parse().ok()).collect();
                column.typed::<Int64Type>().write_batch(&values, Some(&levels), None)?;
            }
            Kind::Doubles => {
                let values: Vec<f64> = rows.iter().filter_map(|row| row[c].parse().ok()).collect();
                column.typed::<DoubleType>().write_batch(&values, Some(&levels), None)?;
            }
            Kind::Text => {
                let values: Vec<ByteArray> =
                    rows.iter().map(|row| ByteArray::from(row[c].as_str())).collect();
                column.typed::<ByteArrayType>().write_batch(&values, None, None)?;
            }
        }
        column.close()?;
    }
    group.close()?;
    writer.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use parquet::{file::reader::FileReader, file::serialized_reader::SerializedFileReader};

    #[test]
    fn what_is_written_is_read_back_and_repeats_itself() {
        let rows: Vec<Vec<String>> = [
            ["a", "word", "seed"],
            // A double cannot hold this one.
            ["1.5", "x", "9007199254740993"],
            ["", "y", "2"],
            ["-2", "", "3"],
        ]
        .iter()
        .map(|row| row.iter().map(|&cell| cell.to_owned()).collect())
        .collect();
        let bytes = encode(&rows).unwrap();
        assert_eq!(bytes, encode(&rows).unwrap());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs.parquet");
        write(&path, &rows).unwrap();
        let reader = SerializedFileReader::new(std::fs::File::open(&path).unwrap()).unwrap();
        let read: Vec<String> =
            reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(read[0], "{a: 1.5, word: \"x\", seed: 9007199254740993}");
        assert_eq!(read[1], "{a: null, word: \"y\", seed: 2}");
        assert_eq!(read.len(), 3);
    }
}
